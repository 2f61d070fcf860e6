"""Training on whole views: the loop over anything that is `Trainable`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, fields
from typing import Protocol

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.learning.loop import Optimisable, TrainingLoop, model_state
from padgs.learning.loss import NORMALISATIONS, ROW_WEIGHTS, photometric_loss
from padgs.learning.method import Budget, Failure, State
from padgs.learning.targets import Target, Targets
from padgs.render import Rendering
from padgs.scene import Scene, View

__all__ = ["Drawing", "TrainOptions", "Trainable", "Trainer", "model_state"]


@dataclass(frozen=True)
class Drawing:
    """What a model drew of one view, with all that the densification statistics need after `backward`."""

    rendering: Rendering
    probe: Tensor  # [N, 2] or [N, 3], see `padgs.splats.probes`; its .grad is filled by backward
    gaussians: Gaussians  # the N that were drawn
    slots: Tensor  # [N] int64: the row of the model's statistics that each drawn Gaussian counts for
    _: KW_ONLY
    penalty: Tensor | None = None  # a scalar to be added to the loss
    photo: Callable[[Target], Target] | None = None  # brings the training image to where it was drawn; differentiable


class Trainable(Optimisable, Protocol):
    """A model that a `Trainer` can optimise."""

    def draw(self, view: View) -> Drawing:
        """Render a view, differentiably."""
        ...

    def observe(self, drawing: Drawing, iteration: int) -> None:
        """Collect statistics; called after `backward` and before the optimiser step."""
        ...

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Grow and prune where it is time to; called after the optimiser step. Returns events for the record."""
        ...


@dataclass(frozen=True)
class TrainOptions:
    """The `train` group of the configuration, without the run length (`Budget`)."""

    lambda_l1: float = 0.8  # lambda of Eq. 16
    weight: str = "solid_angle"  # M of Eq. 17, see `padgs.learning.loss.ROW_WEIGHTS`
    normalisation: str = "mean"  # channel_sum: 3 x the mean, as the released code does
    check_every: int = 50  # iterations between checks of all gradients and parameters; the loss is checked at each

    def __post_init__(self) -> None:
        """Reject unknown names and values without a meaning."""
        if not 0 <= self.lambda_l1 <= 1:
            raise ValueError(f"lambda_l1 is {self.lambda_l1}; it must be in [0, 1]")
        if self.weight not in ROW_WEIGHTS:
            raise ValueError(f"unknown weight {self.weight!r}; known: {', '.join(ROW_WEIGHTS)}")
        if self.normalisation not in NORMALISATIONS:
            raise ValueError(f"unknown normalisation {self.normalisation!r}; known: {', '.join(NORMALISATIONS)}")
        if self.check_every < 1:
            raise ValueError(f"check_every is {self.check_every}; it must be at least 1")


class Trainer(TrainingLoop):
    """Optimises a model on the training views of a scene, one random view per iteration.

    Views are drawn without replacement until all had their turn.
    """

    def __init__(
        self,
        model: Trainable,
        scene: Scene,
        budget: Budget,
        options: TrainOptions = TrainOptions(),
        seed: int = 0,
    ) -> None:
        """Prepare; nothing is drawn yet.

        Raises:
            ValueError: the scene has no training view.
        """
        if not scene.train:
            raise ValueError(f"scene {scene.name!r} has no training view; mend its split")
        super().__init__(model, budget, check_every=options.check_every)
        self._trainee, self._scene, self._options = model, scene, options
        self._targets = Targets(scene.train, options.weight, self._groups[0].parameters[0].device)
        self._shuffler = torch.Generator().manual_seed(seed)
        self._order = torch.randperm(len(scene.train), generator=self._shuffler)  # of the views, this epoch
        self._position = 0  # in that order

    def _step(self, iteration: int) -> tuple[float | Tensor, dict[str, int], tuple[str, ...]]:
        """One iteration: draw, compare, differentiate, observe, update, adapt. Returns loss, counts and events."""
        index = self._next_view()
        self._scene.train[self._upcoming()].prefetch()
        target = self._targets[index]
        drawing = self._trainee.draw(self._scene.train[index])
        if len(drawing.gaussians) == 0:
            self._refuse_non_finite(self._parameters(), iteration)  # a NaN shows nothing either
            raise Failure("collapsed", f"no Gaussian is left to draw at iteration {iteration}")
        if drawing.photo is not None:
            target = drawing.photo(target)
        image = drawing.rendering.image
        options = self._options
        loss = photometric_loss(
            image,
            target.image,
            target.weight,
            options.lambda_l1,
            normalisation=options.normalisation,
            moments=target.moments,
        )
        if drawing.penalty is not None:
            loss = loss + drawing.penalty
        value = self._read(loss, iteration)
        if isinstance(value, float) and not math.isfinite(value):
            inputs = {field.name: getattr(drawing.gaussians, field.name) for field in fields(drawing.gaussians)}
            self._refuse_non_finite({**self._parameters(), **inputs, "image": image, "loss": loss}, iteration)
        loss.backward()
        self._check(iteration)
        with torch.no_grad():
            self._trainee.observe(drawing, iteration)
        drawn = len(drawing.gaussians)
        del drawing, image, loss, target  # the graph must be gone before rows of its leaves come and go
        self._update()
        with torch.no_grad():
            events = self._trainee.adapt(iteration, self._optimizer)
        return value, {**self._trainee.counts(), "drawn": drawn}, events

    def _order_state(self) -> State:
        tensors = {"random/views": self._shuffler.get_state(), "order": self._order}
        return State(tensors, {"position": self._position})

    def _load_order(self, state: State) -> None:
        views = len(state.tensors["order"])
        if views != len(self._scene.train):
            raise ValueError(
                f"the state is of a run with {views} training views, but scene {self._scene.name!r} has "
                f"{len(self._scene.train)}; resume with the data it was trained on"
            )
        self._shuffler.set_state(state.tensors["random/views"].cpu())
        self._order = state.tensors["order"].to("cpu", copy=True)
        self._position = state.values["position"]

    def _next_view(self) -> int:
        if self._position == len(self._order):
            self._order = torch.randperm(len(self._order), generator=self._shuffler)
            self._position = 0
        self._position += 1
        return int(self._order[self._position - 1])

    def _upcoming(self) -> int:
        """The view of the next iteration; at the end of an epoch, where it is not drawn yet, the present one."""
        return int(self._order[min(self._position, len(self._order) - 1)])
