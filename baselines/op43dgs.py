"""OP43DGS ("optimal projection"): explicit 3D Gaussians, each drawn on the tangent plane of the sphere at its mean.

With exact bounds, this is the method as it should be. conf/method/op43dgs_release.yaml has the bounds of its released
code, which grow with the distance of a Gaussian in scene units, and the memory that it then runs out of.
"""

from __future__ import annotations

from padgs.methods.splats.method import SplatMethod
from padgs.render import RenderConfig


class OP43DGSMethod(SplatMethod):
    """See `padgs.training.method.Method`."""

    RENDER = RenderConfig(projection="tangent")
