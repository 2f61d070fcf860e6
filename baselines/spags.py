"""SPaGS: explicit Gaussians seen exactly along each ray, blended without sorting, densified by their 3D gradient.

What is its own: projection `ray` with the 3D filter (variance 0.2 (r / f)^2), hybrid transparency, a Gaussian that
reaches the near sphere is not drawn at all, and a densification signal that knows no image plane. All but the last is
how it renders (conf/method/spags.yaml); spags_sorted blends in the order of the means instead.
"""

from __future__ import annotations

from dataclasses import dataclass

from padgs.render.config import RenderConfig
from padgs.splats.method import SplatMethod, SplatOptions


@dataclass(frozen=True)
class SPaGSOptions(SplatOptions):
    """The published schedule; `opacity_decay` was read from a copy of the code and may belong to that copy alone."""

    densify_from: int = 200
    signal: str = "space_absolute"
    gradient_threshold: float = 5e-5
    sample_clones: bool = True
    reset_opacity: float = 0.1
    opacity_decay: float = 0.001


class SPaGSMethod(SplatMethod):
    """See `padgs.learning.method.Method`."""

    Options = SPaGSOptions
    RENDER = RenderConfig(projection="ray", near_cull="ellipsoid", low_pass=0.2, blending="hybrid", core_size=16)
