"""EgoNeRF: a radiance field on spherical grids, rendered by sampling rays; the comparison that splats nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import torch

from padgs.egonerf.model import EgoNeRF
from padgs.egonerf.options import EgoNeRFOptions
from padgs.egonerf.trainee import EgoNeRFTraining, TrainableEgoNeRF
from padgs.learning.loop import model_state
from padgs.learning.method import Budget, Record, RenderConfig, Size, State
from padgs.learning.rays import RayTrainer
from padgs.learning.views import TrainOptions
from padgs.render import Rendering
from padgs.scene import Scene, View

BACKENDS = ("auto", "torch")


@dataclass(frozen=True)
class EgoNeRFMethodOptions(EgoNeRFOptions, EgoNeRFTraining):
    """The `method` group of the configuration: the model and its training, all in one list."""

    def __post_init__(self) -> None:
        """Check both parts."""
        EgoNeRFOptions.__post_init__(self)
        EgoNeRFTraining.__post_init__(self)
        if self.environment_pretraining and not self.environment:
            raise ValueError(
                f"environment_pretraining is {self.environment_pretraining}, but environment is false; "
                "change one of them"
            )


class EgoNeRFMethod:
    """See `padgs.learning.method.Method`."""

    Options = EgoNeRFMethodOptions
    RENDER = RenderConfig()
    TRAIN = TrainOptions(weight="uniform")

    def __init__(
        self,
        options: EgoNeRFMethodOptions = EgoNeRFMethodOptions(),
        render: RenderConfig = RenderConfig(),  # noqa: B008
        train: TrainOptions = TrainOptions(weight="uniform"),  # noqa: B008
        seed: int = 0,
    ) -> None:
        """Prepare; the model comes with `fit` or `load_state`."""
        self._options, self._render, self._train, self._seed = options, render, train, seed
        self._model: EgoNeRF | None = None
        self._trainer: RayTrainer | None = None
        self._loaded: State | None = None

    def fit(self, scene: Scene, budget: Budget) -> Iterator[Record]:
        """Train, from noise or from a loaded state.

        Raises:
            ValueError: options of the renderer or the loss were asked for that mean nothing to this method.
        """
        self._refuse_strangers()
        if self._loaded is None:
            self._model = EgoNeRF.from_scene(scene, self._options, self._seed)
        self._trainer = RayTrainer(
            TrainableEgoNeRF(self._trained(), self._options, budget.iterations),
            scene.train,
            budget,
            rays=self._options.rays,
            weight=self._train.weight,
            check_every=self._train.check_every,
            seed=self._seed,
        )
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
        centre = torch.tensor(stored.values["centre"], dtype=torch.float64)
        model = EgoNeRF(self._options, centre, stored.values["unit"], stored.values["travel"])
        self._model = model.to(next(iter(stored.tensors.values())).device)
        self._model.load_state_dict(stored.tensors)
        self._trainer, self._loaded = None, state

    def size(self) -> Size:
        """Parameters and their bytes."""
        parameters = list(self._trained().parameters())
        return Size(
            counts={},
            parameters=sum(p.numel() for p in parameters),
            bytes=sum(p.numel() * p.element_size() for p in parameters),
        )

    def _trained(self) -> EgoNeRF:
        if self._model is None:
            raise RuntimeError("there is no model before fit or load_state")
        return self._model

    def _refuse_strangers(self) -> None:
        """Say so where an option is set that this method would have to ignore."""
        loss = TrainOptions(weight=self._train.weight, check_every=self._train.check_every)
        if self._render.backend not in BACKENDS:
            raise ValueError(
                f"egonerf has no backend {self._render.backend!r}; it casts rays in torch, known: {', '.join(BACKENDS)}"
            )
        rays = RenderConfig(backend=self._render.backend)
        for group, given, possible, why in (
            ("render", self._render, rays, "casts rays and draws no Gaussians"),
            ("train", self._train, loss, "minimises the squared error"),
        ):
            for field in fields(possible):
                if getattr(given, field.name) != getattr(possible, field.name):
                    raise ValueError(
                        f"egonerf {why}, so {group}.{field.name}={getattr(given, field.name)} means nothing to it; "
                        f"leave it at {getattr(possible, field.name)}"
                    )
