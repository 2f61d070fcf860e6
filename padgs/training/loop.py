"""The training loop: from a photograph to a step of the optimizer, again and again.

One iteration draws one training view (or several, where a panorama is cut into them), compares it with its photograph,
goes back to the gradients, lets the model note where they are large, steps Adam, and lets the model grow or prune.
Knows no files.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from padgs.clock import Lap
from padgs.scene import Scene
from padgs.training.corrections import LEARNED, Corrections
from padgs.training.health import (
    FADE,
    GAIN,
    PATIENCE,
    Failure,
    Guard,
    Monitor,
    Plateau,
    is_out_of_memory,
    memory_reason,
    quality,
    validation_split,
)
from padgs.training.loss import photometric_loss
from padgs.training.model import MODEL, Model, State
from padgs.training.optimizer import Optimizer
from padgs.training.options import Budget, TrainOptions
from padgs.training.schedule import Pace
from padgs.training.targets import Sizes
from padgs.training.view_order import Order, ViewOrder

READ_EVERY = 10  # iterations: losses are read from a GPU as often as runs log them, while their time is counted
VIEWS = "views/"  # prefix of the corrections of views in the state of a trainer
Stage = Callable[[str], AbstractContextManager[object]]  # entered with the name of each part of an iteration


@dataclass(frozen=True)
class Record:
    """One training iteration, after the optimizer step."""

    iteration: int  # 1 for the first step
    progress: float  # share of the schedule, 1 for the last step
    loss: float | Tensor  # a scalar on the GPU where nobody has read it yet: `float` of it waits for the iteration
    seconds: float  # training time so far, evaluation and files excluded
    cpu_seconds: float  # the same of all threads of the process on the CPU, which other programs change less
    counts: dict[str, int] = field(default_factory=dict)  # anchors, gaussians drawn, ...
    events: tuple[str, ...] = ()  # what happened besides the step: "grew 120 anchors", ...


class Trainer:
    """Optimises a model on the training views of a scene, by default one random view per iteration.

    Attributes:
        iteration, seconds, cpu_seconds: steps that were taken, and what they took.
        schedule: iterations that the schedule is written for.
        moment: the one of them that the last step stood for; not `iteration` in budgets of seconds only.
        step_seconds: what the last step took, on the clock of the budget.
        start: how many Gaussians, anchors or other parts the model had at the beginning.
        skipped, ended: iterations of the schedule that were left out by `stop`, and why; 0 and empty without.

    Between two records `state` holds all that continuing bit-identically needs (on the CPU); `load_state` goes back
    there. A resumed run goes on counting its training time.
    """

    ADAM: ClassVar[dict[str, Any]] = {"betas": (0.9, 0.999), "eps": 1e-15}  # of 3DGS: single Gaussians pull tiny
    PROGRESS = (
        *("iteration", "moment", "schedule", "seconds", "cpu_seconds", "step_seconds", "start"),
        *("skipped", "ended"),
    )

    def __init__(
        self,
        model: Model,
        scene: Scene,
        budget: Budget,
        options: TrainOptions = TrainOptions(),  # noqa: B008 - frozen dataclass
        seed: int = 0,
        *,
        views_each: int = 1,
        coarse_share: float = 0.0,
        stage: Stage = nullcontext,
    ) -> None:
        """Prepare; nothing is drawn yet.

        Args:
            model, scene, budget, options, seed: what is trained, on what, for how long and how.
            views_each: views that an iteration draws one after the other, before Adam steps on the sum of their losses.
            coarse_share: of the run, in which views are smaller than they are, see `padgs.training.targets`.
            stage: for whoever wants to know what an iteration spends its time on.

        Raises:
            ValueError: the run is to stop by itself, but has too few views to set some apart.
        """
        self.iteration = self.moment = self.skipped = 0
        self.ended = ""
        self.schedule = budget.iterations
        self.seconds = self.cpu_seconds = self.step_seconds = 0.0
        self.start = next(iter(model.counts().values()))
        self._model, self._scene, self._budget, self._options, self._stage = model, scene, budget, options, stage
        self._views_each = views_each
        learned = {name: getattr(options, name) == LEARNED for name in ("exposures", "poses")}
        self._corrections = Corrections(scene, **learned)
        groups = model.groups()
        self._corrections.to(groups[0].parameters[0].device)
        groups = [*groups, *self._corrections.groups(budget.iterations)]
        self._optimizer = Optimizer(groups, self._pace(1, 1), options.check_every, **self.ADAM)
        self._guard = Guard(groups, scene, gradients=options.guard_gradients, scales=options.guard_scales)
        self._sizes = Sizes(scene.train, options.weight, self._optimizer.device, coarse_share)
        apart = validation_split(scene.train) if budget.stop == "auto" else ()
        self._calibration = [scene.train[number] for number in apart]
        self._plateau = Plateau(budget.iterations)
        self._fade = min(round((1 - FADE) * budget.iterations), budget.iterations - 1)  # one step at least ends a run
        self._views = ViewOrder(scene, seed, apart)
        self._order: Order = self._views
        pixels = sum(view.width * view.height for view in scene.train)
        self._monitor = Monitor(budget.iterations, max(model.counts().values()), pixels) if options.monitor else None

    def records(self) -> Iterator[Record]:
        """Train to the end of the budget, yielding a record after each iteration.

        Stops early, without an error, once the training time has reached `Budget.max_seconds`; the caller sees it by
        the iteration of the last record and decides which status that is.

        Raises:
            Failure: nan (a loss, gradient or parameter is not finite; the reason names it and the iteration), oom,
                collapsed (nothing is left to draw), or what a `Monitor` sees. The model is of no use then.
        """
        budget, limit = self._budget, self._budget.max_seconds
        while self.moment < budget.iterations and (limit is None or self.seconds < limit):
            lap, iteration = Lap(), self.iteration + 1
            moment = budget.moment(self.moment, self.spent, self.step_seconds, self.skipped)
            if self._monitor is not None:
                self._monitor.moment = moment
                self._monitor.size(self._sizes.halvings(moment / self.schedule), iteration)
            try:
                loss, counts, events = self._step(iteration, moment)
            except (MemoryError, RuntimeError) as error:
                if isinstance(error, Failure) or not is_out_of_memory(error):
                    raise
                raise Failure("oom", f"out of memory at iteration {iteration}: {memory_reason(error)}") from error
            self._watch(loss, iteration)
            if moment == budget.iterations:
                self._optimizer.refuse_non_finite(self._optimizer.parameters(), iteration)
            self.iteration, self.moment, before = iteration, moment, self.spent
            events += self._stopped_by_itself()
            wall, cpu = lap.seconds()
            self.seconds, self.cpu_seconds = self.seconds + wall, self.cpu_seconds + cpu
            self.step_seconds = self.spent - before
            progress = moment / budget.iterations
            yield Record(iteration, progress, loss, self.seconds, self.cpu_seconds, counts, events)

    def request_stop(self, why: str) -> bool:
        """Leave out the schedule up to its last `FADE`, between two records; returns whether anything was left.

        What would have come at moments that are left out does not come.
        """
        if self.moment >= self._fade:
            return False
        self.skipped, self.moment, self.ended = self._fade - self.moment, self._fade, why
        self._views.take_all()
        if self._monitor is not None:
            self._monitor.forget()
        return True

    def _stopped_by_itself(self) -> tuple[str, ...]:
        """Stop where the views set apart say so; when rates fade at the latest, these are trained on."""
        if self.moment >= self._fade:
            self._views.take_all()
        elif self._calibration and self._plateau.is_due(self.moment):
            value = quality(self._model.render, self._calibration)
            if self._plateau.reached(value, max(self._model.counts().values()), self.moment):
                self.request_stop(f"less than {GAIN} dB were gained within {PATIENCE:.0%} of the schedule")
                return (f"stopping: {self.ended}",)
        return ()

    @property
    def spent(self) -> float:
        """Seconds of training so far, on the clock of the budget."""
        return self.seconds if self._budget.clock == "wall" else self.cpu_seconds

    def _pace(self, iteration: int, moment: int) -> Pace:
        """Of the learning rates: what fits as many steps as the run will have, if it goes on as it went so far.

        What is left out of the schedule counts as done, so that rates do not rise when a run is stopped.
        """
        length = self._budget.iterations
        steps = round(length * iteration / (moment - self.skipped))
        return replace(Pace.of(self._options.learning_rates, steps), iterations=length)

    def _step(self, iteration: int, moment: int) -> tuple[float | Tensor, dict[str, int], tuple[str, ...]]:
        """One iteration. Returns loss (a mean over its views), counts and events of its record."""
        model, optimizer, stage = self._model, self._optimizer, self._stage
        losses, drawn = zip(*(self._pull(iteration, moment) for _ in range(self._views_each)), strict=True)
        optimizer.check(iteration, moment)
        optimizer.pace = self._pace(iteration, moment)
        with stage("optimizer"):
            optimizer.step(moment)
            self._guard.bound()
            self._corrections.centre()
        with stage("adapt"), torch.no_grad():
            passed = range(self.moment + 1, moment + 1)  # all that comes at a moment of the schedule comes once
            events = tuple(event for one in passed for event in model.adapt(one, optimizer.adam))
        if optimizer.is_checked(iteration) or moment == self._budget.iterations:
            events += self._guard.look(iteration)
        return sum(losses) / len(losses), {**model.counts(), "drawn": max(drawn)}, events

    def _watch(self, loss: float | Tensor, iteration: int) -> None:
        """Have the monitor look at an iteration."""
        if self._monitor is None:
            return
        if isinstance(loss, float):  # known without waiting for a GPU
            self._monitor.loss(loss, iteration)
        self._monitor.counts(self._model.counts(), iteration)
        if self._optimizer.is_checked(iteration):
            self._monitor.gradients(self._optimizer.silent, iteration)

    def _pull(self, iteration: int, moment: int) -> tuple[float | Tensor, int]:
        """Draw the next view and add its gradients. Returns its loss, and how many Gaussians were drawn."""
        model, optimizer, stage, options = self._model, self._optimizer, self._stage, self._options
        with stage("target"):
            index = self._views.next()
            self._scene.train[self._views.upcoming()].prefetch()
            views, targets = self._sizes.at(moment / self.schedule)
            target = targets[index]
        with stage("draw"):
            drawing = model.draw(self._corrections.posed(views[index]))
            image = self._corrections.exposed(drawing.rendering.image, index)
        if len(drawing.gaussians) == 0:
            optimizer.refuse_non_finite(optimizer.parameters(), iteration)  # a NaN shows nothing either
            raise Failure("collapsed", f"no Gaussian is left to draw at iteration {iteration}")
        with stage("loss"):
            if drawing.photo is not None:
                target = drawing.photo(target)
            loss = photometric_loss(
                image,
                target.image,
                target.weight,
                options.lambda_l1,
                normalisation=options.normalisation,
                statistics=target.statistics,
            )
            if drawing.penalty is not None:
                loss = loss + drawing.penalty
            value = self._read(loss, iteration)
        if isinstance(value, float) and not math.isfinite(value):
            inputs = {field.name: getattr(drawing.gaussians, field.name) for field in fields(drawing.gaussians)}
            optimizer.refuse_non_finite({**optimizer.parameters(), **inputs, "image": image, "loss": loss}, iteration)
        if self._monitor is not None and optimizer.is_checked(iteration):
            self._monitor.picture(drawing, target.image, iteration)
        with stage("backward"):
            loss.backward()
            self._guard.clean(drawing.mean_offsets)
        if self._monitor is not None and optimizer.is_checked(iteration):
            self._monitor.probe(drawing.mean_offsets.grad, iteration)
        with stage("observe"), torch.no_grad():
            model.observe(drawing, moment)
        return value, len(drawing.gaussians)  # and the graph is gone before rows of its leaves come and go

    def _read(self, loss: Tensor, iteration: int) -> float | Tensor:
        """The loss as a number. On a GPU, which the host has to wait for, not each time."""
        if loss.device.type == "cpu" or iteration % READ_EVERY == 0 or self._optimizer.is_checked(iteration):
            return loss.item()
        return loss.detach()

    def take_corrections(self, state: State) -> None:
        """Begin with the corrections of views of another training on this scene, as far as both learn them."""
        self._corrections.load_state_dict(state.under(VIEWS), strict=False)

    def state(self) -> State:
        """Copies of model, optimizer, statistics, random state and data order; to be taken between two records."""
        own, order = self._model.state(), self._order.state()
        tensors = {f"{MODEL}{name}": tensor for name, tensor in own.tensors.items()}
        tensors |= {f"{VIEWS}{name}": tensor for name, tensor in self._corrections.state_dict().items()}
        tensors |= self._optimizer.tensors() | {"random/torch": torch.get_rng_state()} | order.tensors
        values = {"model": own.values, **{name: getattr(self, name) for name in self.PROGRESS}, **order.values}
        values["guard"] = self._guard.state
        if self._monitor is not None:
            values["monitor"] = copy.deepcopy(self._monitor.state)
        if self._calibration:
            values["plateau"] = copy.deepcopy(self._plateau.state)
        return State({name: tensor.detach().clone() for name, tensor in tensors.items()}, values)

    def load_state(self, state: State) -> None:
        """Go on where `state` was taken; model, scene, budget and options must be those of that run.

        Raises:
            ValueError: the state is of a run on other data.
        """
        self._order.load(state)
        self._model.load_state(state.of_model())
        self._corrections.load_state_dict(state.under(VIEWS))
        self._optimizer.load(state)
        torch.set_rng_state(state.tensors["random/torch"].cpu())
        before = {"moment": state.values["iteration"], "schedule": self.schedule, "step_seconds": 0.0}
        before |= {"skipped": 0, "ended": ""}
        for name in self.PROGRESS:  # older checkpoints have some of them less
            setattr(self, name, {**before, **state.values}[name])
        if "guard" in state.values:  # nor the guard
            self._guard.load(state.values["guard"])
        if self._monitor is not None and "monitor" in state.values:  # not in checkpoints from before there was one
            self._monitor.state = copy.deepcopy(state.values["monitor"])
        if self._calibration:
            self._plateau.state = copy.deepcopy(state.values["plateau"])
