"""SPaGS: explicit Gaussians seen exactly along each ray, blended without sorting, densified by their 3D gradient.

What is its own: projection `ray`, hybrid transparency, a Gaussian that reaches the near sphere is not drawn at all (how
it renders, `RENDER`); the 3D filter of its training views (variance 0.2 (r / f)^2), and a densification signal that
knows no image plane. spags_sorted blends in the order of the means instead.
"""

from __future__ import annotations

from dataclasses import dataclass

from padgs.methods.splats.method import SplatMethod, SplatOptions
from padgs.render import RenderConfig


@dataclass(frozen=True)
class SPaGSOptions(SplatOptions):
    """The published schedule; `opacity_decay` is what two copies of the code have."""

    densify_from: int = 200
    signal: str = "space_absolute"
    gradient_threshold: float = 5e-5
    sample_clones: bool = True
    reset_opacity: float = 0.1
    opacity_decay: float = 0.001
    filter_pixels: float = 0.2


class SPaGSMethod(SplatMethod):
    """See `padgs.training.method.Method`."""

    Options = SPaGSOptions
    RENDER = RenderConfig(projection="ray", near_cull="ellipsoid", low_pass=0.0, blending="hybrid", core_size=16)
