"""The training loop: a generator of records over anything that is `Trainable`. Knows no files."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Protocol

import torch
from torch import Tensor, nn

from padgs.gaussians import Gaussians
from padgs.guards import first_non_finite, is_out_of_memory
from padgs.loss import NORMALISATIONS, ROW_WEIGHTS, photometric_loss
from padgs.method import Budget, Failure, Record, State
from padgs.render import Rendering
from padgs.scene import Scene, View
from padgs.schedule import ParameterGroup
from padgs.targets import Targets

MODEL = "model/"  # prefix of the model's own tensors in a state


@dataclass(frozen=True)
class Drawing:
    """What a model drew of one view, with all that the densification statistics need after `backward`."""

    rendering: Rendering
    probe: Tensor  # [N, 2]; its .grad is filled by backward
    gaussians: Gaussians  # the N that were drawn
    slots: Tensor  # [N] int64: the row of the model's statistics that each drawn Gaussian counts for


class Trainable(Protocol):
    """A model that a `Trainer` can optimise.

    `load_state` must make the model what `state` was taken of, sizes included, and may replace the data of parameters
    but not the parameters returned by `groups`.
    """

    def groups(self) -> list[ParameterGroup]:
        """All learnable parameters, each in exactly one group."""
        ...

    def draw(self, view: View) -> Drawing:
        """Render a view, differentiably."""
        ...

    def observe(self, drawing: Drawing, iteration: int) -> None:
        """Collect statistics; called after `backward` and before the optimiser step."""
        ...

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Grow and prune where it is time to; called after the optimiser step. Returns events for the record."""
        ...

    def counts(self) -> dict[str, int]:
        """What the model consists of now: anchors, gaussians, ..."""
        ...

    def state(self) -> State:
        """Parameters, statistics and random state, without the optimiser."""
        ...

    def load_state(self, state: State) -> None:
        """Become the model that `state` was taken of."""
        ...


@dataclass(frozen=True)
class TrainOptions:
    """The `train` group of the configuration, without the run length (`Budget`)."""

    lambda_l1: float = 0.8  # lambda of Eq. 16
    weight: str = "solid_angle"  # M of Eq. 17, see `padgs.loss.ROW_WEIGHTS`
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


class Trainer:
    """Optimises a model on the training views of a scene, one random view per iteration.

    Views are drawn without replacement until all had their turn. Between two records `state` holds all that continuing
    bit-identically needs (on the CPU); `load_state` goes back there. A resumed run goes on counting its training time.
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
        self.iteration = 0
        self.seconds = 0.0
        self._model, self._scene, self._budget, self._options = model, scene, budget, options
        self._groups = model.groups()
        # eps as published: the gradients of single Gaussians are tiny. fused is 2 to 3 times faster on CPUs.
        self._optimizer = torch.optim.Adam(
            [{"params": list(group.parameters), "name": group.name} for group in self._groups], eps=1e-15, fused=True
        )
        self._targets = Targets(scene.train, options.weight, self._groups[0].parameters[0].device)
        self._shuffler = torch.Generator().manual_seed(seed)
        self._order = torch.randperm(len(scene.train), generator=self._shuffler)  # of the views, this epoch
        self._position = 0  # in that order

    def records(self) -> Iterator[Record]:
        """Train to the end of the budget, yielding a record after each iteration.

        Stops early, without an error, once the training time has reached `Budget.max_seconds`; the caller sees it by
        the iteration of the last record and decides which status that is.

        Raises:
            Failure: nan (a loss, gradient or parameter is not finite; the reason names it and the iteration), oom, or
                collapsed (nothing is left to draw). The model is of no use then.
        """
        limit = self._budget.max_seconds
        while self.iteration < self._budget.iterations and (limit is None or self.seconds < limit):
            started = time.perf_counter()
            iteration = self.iteration + 1
            try:
                loss, counts, events = self._step(iteration)
            except (MemoryError, RuntimeError) as error:
                if isinstance(error, Failure) or not is_out_of_memory(error):
                    raise
                raise Failure("oom", f"out of memory at iteration {iteration}: {error}") from error
            self.iteration = iteration
            self.seconds += time.perf_counter() - started
            yield Record(iteration, loss, self.seconds, counts, events)

    def state(self) -> State:
        """Copies of model, optimiser, statistics, random state and data order; to be taken between two records."""
        model = self._model.state()
        tensors = {f"{MODEL}{name}": tensor for name, tensor in model.tensors.items()}
        for name, parameter in self._parameters().items():
            for key, value in self._optimizer.state.get(parameter, {}).items():
                tensors[f"adam/{name}/{key}"] = value
        tensors["random/torch"] = torch.get_rng_state()
        tensors["random/views"] = self._shuffler.get_state()
        tensors["order"] = self._order
        values = {
            "model": model.values,
            "iteration": self.iteration,
            "seconds": self.seconds,
            "position": self._position,
        }
        return State({name: tensor.detach().clone() for name, tensor in tensors.items()}, values)

    def load_state(self, state: State) -> None:
        """Go on where `state` was taken; model, scene, budget and options must be those of that run.

        Raises:
            ValueError: the state is of a run with another number of training views.
        """
        views = len(state.tensors["order"])
        if views != len(self._scene.train):
            raise ValueError(
                f"the state is of a run with {views} training views, but scene {self._scene.name!r} has "
                f"{len(self._scene.train)}; resume with the data it was trained on"
            )
        self._model.load_state(model_state(state))
        self._optimizer.state.clear()
        for name, parameter in self._parameters().items():
            prefix = f"adam/{name}/"
            moments = {
                key.removeprefix(prefix): value for key, value in state.tensors.items() if key.startswith(prefix)
            }
            if moments:
                self._optimizer.state[parameter] = {key: value.clone() for key, value in moments.items()}
        torch.set_rng_state(state.tensors["random/torch"])
        self._shuffler.set_state(state.tensors["random/views"])
        self._order = state.tensors["order"].clone()
        self._position = state.values["position"]
        self.iteration, self.seconds = state.values["iteration"], state.values["seconds"]

    def _step(self, iteration: int) -> tuple[float, dict[str, int], tuple[str, ...]]:
        """One iteration: draw, compare, differentiate, observe, update, adapt. Returns loss, counts and events."""
        for group, settings in zip(self._groups, self._optimizer.param_groups, strict=True):
            settings["lr"] = group.learning_rate(iteration)
        index = self._next_view()
        self._scene.train[self._upcoming()].prefetch()
        target = self._targets[index]
        drawing = self._model.draw(self._scene.train[index])
        if len(drawing.gaussians) == 0:
            raise Failure("collapsed", f"no Gaussian is left to draw at iteration {iteration}")
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
        value = loss.item()
        if not math.isfinite(value):
            inputs = {field.name: getattr(drawing.gaussians, field.name) for field in fields(drawing.gaussians)}
            self._refuse_non_finite({**self._parameters(), **inputs, "image": image, "loss": loss}, iteration)
        loss.backward()
        if iteration % options.check_every == 0:
            gradients = {f"gradient of {name}": parameter.grad for name, parameter in self._parameters().items()}
            self._refuse_non_finite({**self._parameters(), **gradients}, iteration)
        with torch.no_grad():
            self._model.observe(drawing, iteration)
        drawn = len(drawing.gaussians)
        del drawing, image, loss  # the graph must be gone before rows of its leaves come and go
        self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            events = self._model.adapt(iteration, self._optimizer)
        if iteration == self._budget.iterations:
            self._refuse_non_finite(self._parameters(), iteration)
        return value, {**self._model.counts(), "drawn": drawn}, events

    def _next_view(self) -> int:
        if self._position == len(self._order):
            self._order = torch.randperm(len(self._order), generator=self._shuffler)
            self._position = 0
        self._position += 1
        return int(self._order[self._position - 1])

    def _upcoming(self) -> int:
        """The view of the next iteration; at the end of an epoch, where it is not drawn yet, the present one."""
        return int(self._order[min(self._position, len(self._order) - 1)])

    def _parameters(self) -> dict[str, nn.Parameter]:
        """All parameters by a name for messages and checkpoints."""
        return {
            group.name if len(group.parameters) == 1 else f"{group.name}[{number}]": parameter
            for group in self._groups
            for number, parameter in enumerate(group.parameters)
        }

    def _refuse_non_finite(self, tensors: Mapping[str, Tensor | None], iteration: int) -> None:
        bad = first_non_finite(tensors)
        if bad is not None:
            every = self._options.check_every
            raise Failure(
                "nan", f"{bad} at iteration {iteration} (all parameters are checked every {every} iterations)"
            )


def model_state(state: State) -> State:
    """The model's own part of what `Trainer.state` returned, for models that are only looked at."""
    tensors = {name.removeprefix(MODEL): t for name, t in state.tensors.items() if name.startswith(MODEL)}
    return State(tensors, state.values["model"])
