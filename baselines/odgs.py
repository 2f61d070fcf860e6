"""ODGS: explicit 3D Gaussians on the tangent plane of each mean, scaled to the pixels of the panorama.

That footprint is the one through the Jacobian of the panorama (tests/baselines/test_odgs.py), so the method renders
with projection `erp`. What is its own is a densification with half the threshold of 3DGS, which may rise towards the
poles (`polar_threshold`). conf/method/odgs_release.yaml has what its released code does otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

from padgs.methods.splats.method import SplatMethod, SplatOptions


@dataclass(frozen=True)
class ODGSOptions(SplatOptions):
    """As published, where the threshold is the same at all latitudes."""

    gradient_threshold: float = 1e-4


class ODGSMethod(SplatMethod):
    """See `padgs.training.method.Method`."""

    Options = ODGSOptions
