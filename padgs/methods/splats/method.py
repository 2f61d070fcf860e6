"""Explicit Gaussians as a method: what OmniGS, ODGS, OP43DGS and others of the 3DGS family have in common.

They differ in options only: of the densification (`padgs.methods.splats.clone_split`), the renderer and the loss. Each is a
subclass in `baselines` that says which.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from padgs.checks import check
from padgs.geometry.harmonics import MAX_DEGREE
from padgs.methods.splats.clone_split import CloneSplitOptions
from padgs.methods.splats.model import Splats
from padgs.methods.splats.trainee import SplatTrainee
from padgs.scene import Scene, View
from padgs.training.initial_points import ExtentOptions
from padgs.training.method import Method
from padgs.training.model import State
from padgs.training.options import AUTO, TrainOptions

REMOVAL_PSNR = 44.0  # dB, under budget.gaussians=auto; see `padgs.training.worth.needed`


@dataclass(frozen=True)
class SplatOptions(CloneSplitOptions, ExtentOptions):
    """The `method` group of the configuration: the model, and its densification."""

    sh_degree: int = 3  # 0: colours do not depend on the direction
    # Variance in square pixels of the training view that has the finest one at a Gaussian, which is wider by that in
    # whatever view (the 3D filter of Mip-Splatting and SPaGS, `padgs.methods.splats.nearest`); 0: none.
    filter_pixels: float = 0.0

    def __post_init__(self) -> None:
        for part in (CloneSplitOptions, ExtentOptions):
            part.__post_init__(self)
        check(self, f"0 to {MAX_DEGREE}", lambda degree: 0 <= degree <= MAX_DEGREE, "sh_degree")
        check(self, "a variance >= 0 in square pixels", lambda v: 0 <= v < math.inf, "filter_pixels")


def refuse_polar_threshold(options: SplatOptions, why: str) -> None:
    """For methods whose training views are not the panorama that the latitudes of a threshold are of.

    Raises:
        ValueError: there is such a threshold.
    """
    if options.polar_threshold is not None:
        raise ValueError(f"method.polar_threshold is {options.polar_threshold}, but {why}; set it to null")


def fewest(*limits: int | None) -> int | None:
    """The smallest of some numbers; None, which is no limit, where there is none."""
    return min((limit for limit in limits if limit is not None), default=None)


class SplatMethod(Method):
    """See `padgs.training.method.Method`; a subclass says which options, and how it is drawn."""

    Options = SplatOptions
    TRAINEE: ClassVar[Callable[..., SplatTrainee]] = SplatTrainee
    TRAIN = TrainOptions(weight="uniform")

    def _refuse_impossible(self) -> None:
        super()._refuse_impossible()
        if self.options.signal == "space_absolute" and self.render_config.projection != "ray":
            raise ValueError(
                f"method.signal=space_absolute is made for render.projection=ray, not {self.render_config.projection}; "
                "set method.signal=space"
            )

    def build_model(self, scene: Scene, iterations: int) -> SplatTrainee:
        """See `Method.build_model`."""
        options = self.options
        generator = torch.Generator().manual_seed(self.seed)
        most = fewest(options.max_gaussians, self._target)
        splats = Splats.from_scene(scene, degree=options.sh_degree, max_gaussians=most, generator=generator)
        return self._trainee_of(splats, options.extent_of(scene), iterations, scene.train)

    @property
    def _target(self) -> int | None:
        """As many Gaussians as the budget asks for, if it names a number."""
        return self._gaussians if isinstance(self._gaussians, int) else None

    @property
    def _removal_psnr(self) -> float | None:
        """Of the changes, each alone, by what is taken away a round after growth, dB; None if nothing is."""
        return REMOVAL_PSNR if self._gaussians == AUTO else None

    def restore(self, state: State) -> SplatTrainee:
        """See `Method.restore`."""
        stored = state.of_model()
        values, empty = stored.values, stored.tensors["splats/means"][:0]
        splats = Splats(empty, empty, empty, degree=self.options.sh_degree, unit=values["unit"])
        return self._trainee_of(splats, values["extent"], values["iterations"])

    def _trainee_of(
        self, splats: Splats, extent: float, iterations: int, views: Sequence[View] = (), **more: Any
    ) -> SplatTrainee:
        """A trainee of the kind that this method has; `more` is what that kind takes besides."""
        return self.TRAINEE(
            splats,
            self.options,
            self.render_config,
            extent=extent,
            iterations=iterations,
            views=views,
            target=self._target,
            seed=self.seed,
            asked=self._gaussians,
            removal_psnr=self._removal_psnr,
            filter_pixels=self.options.filter_pixels,
            **more,
        )
