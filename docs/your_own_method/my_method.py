"""Example of a method in another package: explicit Gaussians that start thinner."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from padgs.checks import check
from padgs.methods.splats.method import SplatMethod, SplatOptions
from padgs.methods.splats.model import SplatModel
from padgs.render import RenderConfig
from padgs.scene import Scene


@dataclass(frozen=True)
class MyOptions(SplatOptions):
    """The `method` group for `method=my_method`: options of explicit Gaussians and one more."""

    thinner: float = 2.0  # divisor of the initial scales

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "> 0 and finite", lambda factor: 0 < factor < math.inf, "thinner")


class MyMethod(SplatMethod):
    """See `padgs.training.method.Method` and `padgs.methods.splats.method.SplatMethod`."""

    Options = MyOptions
    RENDER = RenderConfig(projection="ray")

    def build_model(self, scene: Scene, iterations: int) -> SplatModel:
        """See `Method.build_model`."""
        model = super().build_model(scene, iterations)
        with torch.no_grad():
            model.splats.log_scales -= math.log(self.options.thinner)
        return model
