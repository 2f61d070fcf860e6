"""SPaGS (Li et al. 2025): explicit Gaussians evaluated exactly along each ray, blended without sorting.

Also its own: a Gaussian that reaches the near sphere is culled as a whole, a 3D smoothing filter of the training views
(variance 0.2 (r / f)^2), and densification by the gradient in space. spags_sorted blends in the order of the means.
"""

from dataclasses import dataclass

from padgs.methods.splats.method import SplatMethod, SplatOptions
from padgs.render import RenderConfig


@dataclass(frozen=True)
class SPaGSOptions(SplatOptions):
    """The published schedule; `opacity_decay` is the value in two copies of the code."""

    densify_from: int = 200
    positional_gradient: str = "space_absolute"
    gradient_threshold: float = 5e-5
    sample_clones: bool = True
    reset_opacity: float = 0.1
    opacity_decay: float = 0.001
    smoothing_filter: float = 0.2


class SPaGSMethod(SplatMethod):
    """SPaGS (Li, Hahlbohm et al. 2025): responses along rays, hybrid transparency with a core of 16."""

    Options = SPaGSOptions
    RENDER = RenderConfig(projection="ray", near_cull="ellipsoid", low_pass=0.0, blending="hybrid", core_size=16)
