"""Explicit Gaussians as a method: what OmniGS, ODGS, OP43DGS and others of the 3DGS family have in common.

They differ in options only: of the densification (`padgs.splats.clone_split`), the renderer and the loss. Each is a
subclass in `baselines` that says which.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import torch

from padgs.learning.method import Budget, Record, RenderConfig, Size, State
from padgs.learning.views import Trainer, TrainOptions, model_state
from padgs.render import Rendering
from padgs.scene import Scene, View
from padgs.splats.clone_split import CloneSplitOptions
from padgs.splats.model import Splats
from padgs.splats.trainee import TrainableSplats, extent_of


@dataclass(frozen=True)
class SplatOptions(CloneSplitOptions):
    """The `method` group of the configuration: the model, and its densification."""

    sh_degree: int = 3  # 0: colours do not depend on the direction
    learning_rate_factor: float = 1.0  # on all learning rates of Gaussians; cameras have their own

    def __post_init__(self) -> None:
        """Reject what nothing can be learned with."""
        super().__post_init__()
        if not self.learning_rate_factor > 0:
            raise ValueError(f"learning_rate_factor is {self.learning_rate_factor}; it must be > 0")


def refuse_polar_threshold(options: SplatOptions, why: str) -> None:
    """For methods whose training views are not the panorama that the latitudes of a threshold are of.

    Raises:
        ValueError: there is such a threshold.
    """
    if options.polar_threshold is not None:
        raise ValueError(f"method.polar_threshold is {options.polar_threshold}, but {why}; set it to null")


class SplatMethod:
    """`padgs.learning.method.Method`.

    Attributes:
        Options: what `method` holds in the configuration.
        RENDER, TRAIN: how the method is drawn and trained unless the configuration says otherwise.
    """

    Options: ClassVar[type[SplatOptions]] = SplatOptions
    RENDER: ClassVar[RenderConfig] = RenderConfig()
    TRAIN: ClassVar[TrainOptions] = TrainOptions(weight="uniform")

    def __init__(
        self,
        options: SplatOptions | None = None,
        render: RenderConfig | None = None,
        train: TrainOptions | None = None,
        seed: int = 0,
    ) -> None:
        """Prepare; the model comes with `fit` or `load_state`."""
        self._options, self._render, self._train = options or self.Options(), render or self.RENDER, train or self.TRAIN
        self._seed = seed
        self._model: TrainableSplats | None = None
        self._trainer: Trainer | None = None
        self._loaded: State | None = None

    def fit(self, scene: Scene, budget: Budget) -> Iterator[Record]:
        """Train, from the point cloud of the scene or from a loaded state."""
        if self._loaded is not None and self._model is not None:
            splats = self._model.splats
        else:
            splats = self._from_points(scene)
        self._model = self._wrap(splats, extent_of(scene), budget.iterations)
        self._trainer = Trainer(self._model, scene, budget, self._train, self._seed)
        if self._loaded is not None:
            self._trainer.load_state(self._loaded)
            self._loaded = None
        yield from self._trainer.records()

    def render(self, view: View) -> Rendering:
        """Render a view without gradients."""
        return self._trained().render(view)

    def state(self) -> State:
        """All that going on bit-identically needs."""
        if self._trainer is not None:
            return self._trainer.state()
        if self._loaded is not None:
            return self._loaded
        raise RuntimeError("the method has no state before fit or load_state")

    def load_state(self, state: State) -> None:
        """Become the method that `state` was taken of, ready to render and to go on."""
        stored = model_state(state)
        values, empty = stored.values, stored.tensors["splats/means"][:0]
        splats = Splats(empty, empty, empty, degree=self._options.sh_degree, unit=values["unit"])
        self._model = self._wrap(splats, values["extent"], values["iterations"])
        self._model.load_state(stored)
        self._trainer, self._loaded = None, state

    def size(self) -> Size:
        """Counts and bytes of the model."""
        parameters = self._trained().splats.rows().values()
        return Size(
            counts=self._trained().counts(),
            parameters=sum(p.numel() for p in parameters),
            bytes=sum(p.numel() * p.element_size() for p in parameters),
        )

    def _from_points(self, scene: Scene) -> Splats:
        options = self._options
        generator = torch.Generator().manual_seed(self._seed)
        return Splats.from_scene(
            scene, degree=options.sh_degree, max_gaussians=options.max_gaussians, generator=generator
        )

    def _wrap(self, splats: Splats, extent: float, iterations: int) -> TrainableSplats:
        return TrainableSplats(
            splats,
            self._options,
            self._render,
            extent=extent,
            iterations=iterations,
            learning_rate_factor=self._options.learning_rate_factor,
            seed=self._seed,
        )

    def _trained(self) -> TrainableSplats:
        if self._model is None:
            raise RuntimeError("there is no model before fit or load_state")
        return self._model
