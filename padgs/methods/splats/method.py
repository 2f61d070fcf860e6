"""Explicit Gaussians as a method: common base of OmniGS, ODGS, OP43DGS and other methods of the 3DGS family.

They differ in their options: densification (`padgs.methods.splats.densification`), renderer and loss. Each is a
subclass in `baselines`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from padgs.checks import check
from padgs.geometry.harmonics import MAX_DEGREE
from padgs.methods.splats.densification import DensificationOptions
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import Splats
from padgs.scene import Scene, View
from padgs.training.initial_points import ExtentOptions
from padgs.training.method import Method
from padgs.training.model import State
from padgs.training.options import AUTO, TrainOptions

PRUNE_PSNR = 44.0  # dB, with budget.gaussians=auto; see `padgs.methods.splats.importance.count_for_psnr`


@dataclass(frozen=True)
class SplatOptions(DensificationOptions, ExtentOptions):
    """The `method` group of the configuration: the model and its densification."""

    sh_degree: int = 3  # 0: colours do not depend on the direction
    # Variance in square pixels of the finest training view (3D smoothing filter of Mip-Splatting and SPaGS,
    # `padgs.methods.splats.smoothing_filter`); 0: none.
    smoothing_filter: float = 0.0

    def __post_init__(self) -> None:
        for part in (DensificationOptions, ExtentOptions):
            part.__post_init__(self)
        check(self, f"0 to {MAX_DEGREE}", lambda degree: 0 <= degree <= MAX_DEGREE, "sh_degree")
        check(self, "a variance >= 0 in square pixels", lambda v: 0 <= v < math.inf, "smoothing_filter")


def lowest_limit(*limits: int | None) -> int | None:
    """Return the smallest limit; None means no limit."""
    return min((limit for limit in limits if limit is not None), default=None)


class SplatMethod(Method):
    """See `padgs.training.method.Method`; subclasses set options, model class and renderer defaults."""

    Options = SplatOptions
    MODEL: ClassVar[Callable[..., SplatModel]] = SplatModel
    TRAIN = TrainOptions(weight="uniform")

    def _refuse_impossible(self) -> None:
        super()._refuse_impossible()
        if self.options.positional_gradient == "space_absolute" and self.render_config.projection != "ray":
            raise ValueError(
                "method.positional_gradient=space_absolute is made for render.projection=ray, not "
                f"{self.render_config.projection}; set method.positional_gradient=space"
            )

    def build_model(self, scene: Scene, iterations: int) -> SplatModel:
        """See `Method.build_model`."""
        options = self.options
        generator = torch.Generator().manual_seed(self.seed)
        limit = lowest_limit(options.max_gaussians, self._target)
        splats = Splats.from_scene(scene, degree=options.sh_degree, max_gaussians=limit, generator=generator)
        return self._model_of(splats, options.extent_of(scene), iterations, scene.train)

    @property
    def _target(self) -> int | None:
        """Number of Gaussians that densification aims at, if the budget is a number."""
        return self._gaussians if isinstance(self._gaussians, int) else None

    @property
    def _prune_psnr(self) -> float | None:
        """PSNR of the pruning step, dB; None without pruning."""
        return PRUNE_PSNR if self._gaussians == AUTO else None

    def restore(self, state: State) -> SplatModel:
        """See `Method.restore`."""
        stored = state.of_model()
        values, empty = stored.values, stored.tensors["splats/means"][:0]
        splats = Splats(empty, empty, empty, degree=self.options.sh_degree, scene_scale=values["scene_scale"])
        return self._model_of(splats, values["extent"], values["iterations"])

    def _model_of(
        self, splats: Splats, extent: float, iterations: int, views: Sequence[View] = (), **more: Any
    ) -> SplatModel:
        """Return the trainable model; `more` are further arguments of `MODEL`."""
        return self.MODEL(
            splats,
            self.options,
            self.render_config,
            extent=extent,
            iterations=iterations,
            views=views,
            target=self._target,
            seed=self.seed,
            requested=self._gaussians,
            prune_psnr=self._prune_psnr,
            smoothing_filter=self.options.smoothing_filter,
            **more,
        )
