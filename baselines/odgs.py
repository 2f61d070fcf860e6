"""ODGS (Lee et al. 2024): explicit Gaussians on the tangent plane of each mean, scaled to the pixels of the panorama.

This footprint equals the one through the Jacobian of the panorama (tests/baselines/test_odgs.py), so the method renders
with projection `erp`. Its densification has half the threshold of 3DGS.
"""

import math
from dataclasses import dataclass
from typing import Any

from padgs.checks import check
from padgs.gaussians import Gaussians
from padgs.methods.splats.method import SplatMethod, SplatOptions
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import Splats
from padgs.render import Rendering, RenderOptions
from padgs.scene import View


@dataclass(frozen=True)
class ODGSOptions(SplatOptions):
    """Options as published; the last two are deviations of the released code (conf/method/odgs_release.yaml)."""

    gradient_threshold: float = 1e-4
    pixel_bias: float = 0.0  # pixels that means are rendered too far right and down; released: 0.5
    extent_margin: float = 0.0  # world units added to the extent that sizes are compared with; released: 100

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "finite", math.isfinite, "pixel_bias")
        check(self, ">= 0 and finite", lambda margin: 0 <= margin < math.inf, "extent_margin")


class ODGSModel(SplatModel):
    """Splats with the deviations of the released code."""

    options: ODGSOptions

    def __init__(self, splats: Splats, options: ODGSOptions, *args: Any, **kwargs: Any) -> None:
        super().__init__(splats, options, *args, **kwargs)
        self.densifier.extent += options.extent_margin

    def _rendered(self, gaussians: Gaussians, view: View, options: RenderOptions, **offsets: Any) -> Rendering:
        if self.options.pixel_bias:
            means, given = gaussians.means, offsets.get("mean_offsets")
            bias = 2 * self.options.pixel_bias / means.new_tensor([view.camera.width, view.camera.height])
            offsets["mean_offsets"] = bias.expand(len(means), 2) if given is None else given + bias
        return super()._rendered(gaussians, view, options, **offsets)


class ODGSMethod(SplatMethod):
    """ODGS (Lee et al. 2024), with learning rates by its own law."""

    Options = ODGSOptions
    MODEL = ODGSModel
    RUN_RATES = "run_linear"

    def _refuse_impossible(self) -> None:
        super()._refuse_impossible()
        if self.options.extent_margin and self.options.length_unit != "extent":
            margin, unit = self.options.extent_margin, self.options.length_unit
            raise ValueError(f"method.extent_margin={margin} is added to the extent, not to length_unit={unit}: set 0")
        if self.options.pixel_bias and self.render_config.projection != "erp":
            raise ValueError(
                f"method.pixel_bias is a deviation of render.projection=erp, not {self.render_config.projection}; "
                "set method.pixel_bias=0"
            )
