"""Seam360GS (arXiv 2508.20080): Gaussians trained through the two fisheye lenses that made the panorama.

Implemented after the abstract, without the paper and without code, which is not public. docs/methods.md lists what is
stated there and what is inferred.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from padgs.checks import check, check_known
from padgs.geometry.camera import RayTable
from padgs.geometry.lens import AXES
from padgs.methods.calibration.lenses import DualLens
from padgs.methods.calibration.model import CalibratedMethod
from padgs.methods.splats.method import SplatOptions
from padgs.render import RenderConfig
from padgs.render.contract import check_camera
from padgs.scene import Scene


@dataclass(frozen=True)
class Seam360GSOptions(SplatOptions):
    """Options of explicit Gaussians and of the lenses; the values of the latter are inferred."""

    lens_axis: str = "z"  # x, y or z of the camera; the seam is the plane across it
    lens_order: int = 2  # coefficients of the radial map per lens
    lens_blend: float = 5.0  # degrees on both sides of the seam where both lenses are blended
    gap_rate: float = 1e-3  # initial learning rate of the gap, scene units
    coefficient_rate: float = 1e-3  # initial learning rate of the radial maps

    def __post_init__(self) -> None:
        super().__post_init__()
        check_known(self, lens_axis=AXES)
        check(self, "at least 1", lambda order: order >= 1, "lens_order")
        check(self, "in [0, 90) degrees", lambda degrees: 0 <= degrees < 90, "lens_blend")
        check(self, "a learning rate > 0", lambda rate: 0 < rate < math.inf, "gap_rate", "coefficient_rate")


class Seam360GSMethod(CalibratedMethod):
    """See `padgs.training.method.Method`. Trained through `DualLens`; `render` is the ideal camera, without a seam.

    Projection erp cannot render the rays of a lens.
    """

    Options = Seam360GSOptions
    RENDER = RenderConfig(projection="ray")

    def _refuse_impossible(self) -> None:
        super()._refuse_impossible()
        check_camera(RayTable(torch.zeros(1, 1, 3), focal=1.0), self.render_config.options(scene_scale=1.0))

    def initial_calibration(self, scene: Scene) -> DualLens:
        """See `CalibratedMethod.initial_calibration`."""
        return self.restored_calibration({"scene_scale": scene.scale})

    def restored_calibration(self, values: Mapping[str, Any]) -> DualLens:
        """See `CalibratedMethod.restored_calibration`."""
        options = self.options
        return DualLens(
            axis=options.lens_axis,
            order=options.lens_order,
            blend=options.lens_blend,
            scene_scale=values["scene_scale"],
            gap_rate=options.gap_rate,
            coefficient_rate=options.coefficient_rate,
        )
