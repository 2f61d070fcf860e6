"""The training loop: render a training view, compare it with its image, back-propagate, step Adam, densify."""

import copy
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ClassVar

import torch
from torch import Tensor

from padgs.clock import Lap
from padgs.scene import Scene
from padgs.training.corrections import Corrections
from padgs.training.health import EarlyStopping, Failure, Monitor, is_out_of_memory, memory_reason
from padgs.training.model import MODEL, Model, Record, State
from padgs.training.optimizer import Optimizer
from padgs.training.options import Budget, TrainOptions
from padgs.training.schedule import Pace
from padgs.training.targets import TrainingViews

VIEWS = "views/"  # prefix of view corrections in the state of a trainer
Stage = Callable[[str], AbstractContextManager[object]]  # entered with the name of each part of an iteration


class Trainer:
    """Trains a model on the training views of a scene, by default one random view per iteration.

    Attributes:
        iteration, seconds, cpu_seconds: iterations so far, and the time they took.
        schedule: length of the schedule, in steps.
        step: last schedule step; `iteration` unless the budget is in seconds or part of the schedule was skipped.
        durations: of the last two iterations, on the clock of the budget.
        began: seconds before the first iteration, on the clock of the budget.
        start: number of Gaussians, anchors or other parts at the beginning.
        skipped, ended: schedule steps that `request_stop` skipped, and its reason.
        corrections: learned exposures, poses and lens of the training views.

    `state`, taken between two records, holds all that `load_state` needs to resume bit-identically (on the CPU).
    """

    ADAM_EPS: ClassVar[float] = 1e-15  # as 3DGS: gradients of a Gaussian are tiny
    TIMES = ("seconds", "cpu_seconds", "durations", "began")
    PROGRESS = ("iteration", "step", "schedule", "start", "skipped", "ended", *TIMES)

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
        """Prepare; nothing is rendered yet.

        `views_each` are the panoramas per iteration, or photographs that show as much: Adam steps on the sum of their
        losses, each weighted by the share of the sphere that it shows. Views are smaller in `coarse_share` of the run,
        see `padgs.training.targets.Targets`. `stage` is entered with the name of each part of an iteration, for timing.
        """
        self.iteration = self.step = self.skipped = 0
        self.ended = ""
        self.schedule = budget.iterations
        self.seconds = self.cpu_seconds = self.began = 0.0
        self.durations: list[float] = []
        self.start = next(iter(model.counts().values()))
        self._model, self._budget, self._options, self._stage = model, budget, options, stage
        self._views_each, self._seed = views_each, seed
        self.corrections = Corrections(scene, options)
        groups = model.groups()
        self._device = groups[0].parameters[0].device
        self.corrections.to(self._device)
        groups = [*groups, *self.corrections.groups(budget.iterations)]
        self._optimizer = Optimizer(groups, options.check_every, betas=(0.9, options.adam_beta2), eps=self.ADAM_EPS)
        self._early_stopping = EarlyStopping(scene.train, budget)
        held_out = self._early_stopping.held_out
        self._unit, depth = scene.scale, options.depth_kind if options.depth_weight > 0 else ""
        self._views = TrainingViews(scene, options.weight, self._device, coarse_share, seed, held_out, depth=depth)
        self._order: Any = self._views  # its state decides which data the next iterations see
        pixels = sum(view.width * view.height for view in scene.train)
        self._monitor = Monitor(budget.iterations, max(model.counts().values()), pixels, active=options.monitor)

    def records(self) -> Iterator[Record]:
        """Train to the end of the budget, a record per iteration; a `Failure` (nan, oom, `Monitor`) ends it."""
        budget, limit = self._budget, self._budget.max_seconds
        while self.step < budget.iterations and (limit is None or self.seconds < limit):
            lap, iteration = Lap(), self.iteration + 1
            # The shorter of two: after one long iteration, as when the machine slept, the next ones are short again.
            expected = min(self.durations, default=0.0)
            step = budget.next_step(self.step, self.spent, expected, skipped=self.skipped, began=self.began)
            self._monitor.begin(step, self._views.halvings(step / self.schedule), iteration)
            try:
                loss, sizes = self._gradients(iteration, step)
                events = self._update(iteration, step)
            except (MemoryError, RuntimeError) as error:
                if isinstance(error, Failure) or not is_out_of_memory(error):
                    raise
                raise Failure("oom", f"out of memory at iteration {iteration}: {memory_reason(error)}") from error
            counts = self._model.counts()
            if isinstance(loss, float):
                self._monitor.loss(loss, iteration)
            self._monitor.counts(counts, iteration)
            if step == budget.iterations:
                self._optimizer.refuse_non_finite(self._optimizer.parameters(), iteration)
            self.iteration, self.step, before = iteration, step, self.spent
            if step >= self._early_stopping.fade:
                self._views.include_held_out()
            elif reason := self._early_stopping.reason(self._model, step):
                self.request_stop(reason)
                events += (f"stopping: {reason}",)
            wall, cpu = lap.seconds()
            self.seconds, self.cpu_seconds = self.seconds + wall, self.cpu_seconds + cpu
            self.durations = [*self.durations[-1:], self.spent - before]
            progress = step / budget.iterations
            yield Record(iteration, progress, loss, self.seconds, self.cpu_seconds, {**counts, **sizes}, events)

    def request_stop(self, reason: str) -> bool:
        """Skip the schedule and its events up to the final fade, between two records; return whether any was left."""
        if self.step >= self._early_stopping.fade:
            return False
        self.skipped, self.step, self.ended = self._early_stopping.fade - self.step, self._early_stopping.fade, reason
        self._views.include_held_out()
        self._monitor.state["since"] = {}  # durations of signs mean nothing after the schedule has jumped
        return True

    @property
    def spent(self) -> float:
        """Seconds of training so far, on the clock of the budget."""
        return self.seconds if self._budget.clock == "wall" else self.cpu_seconds

    def _gradients(self, iteration: int, step: int) -> tuple[float | Tensor, dict[str, int]]:
        """Render the next views and go back to the gradients; return mean loss and further counts."""
        model, optimizer, stage, options = self._model, self._optimizer, self._stage, self._options
        checked, losses, drawn = optimizer.is_checked(iteration), [], []
        room = float(self._views_each)
        while not drawn or self._views.fits(room):
            with stage("target"):
                index, view, target = self._views.next(step / self.schedule)
            room -= view.sphere_share
            with stage("draw"):
                rendered = self.corrections.draw(model, view)
                image = self.corrections.exposed(rendered.rendering.image, index)
            if len(rendered.gaussians) == 0:
                optimizer.refuse_non_finite(optimizer.parameters(), iteration)  # NaN parameters draw nothing either
                raise Failure("collapsed", f"no Gaussian is left to draw at iteration {iteration}")
            with stage("loss"):
                target = self.corrections.undistorted(view, target)
                if options.random_background:
                    color = background(iteration, self._seed)
                    image = target.with_background(image, rendered.rendering.transmittance, color)
                loss = target.loss(image, rendered.rendering.depth, options, self._unit)
                loss = loss if rendered.penalty is None else loss + rendered.penalty
                losses.append(optimizer.read(loss, {**vars(rendered.gaussians), "image": image}, iteration))
                # Not read before: squared errors that set in are no divergence.
                loss = loss + target.squares(image, options, step / self.schedule)
                loss = loss if view.sphere_share == 1 else view.sphere_share * loss
            if checked:
                self._monitor.render(rendered, target, iteration)
            with stage("backward"):
                loss.backward()
            with stage("observe"), torch.no_grad():
                model.observe(rendered, step)
            drawn.append(len(rendered.gaussians))
        return sum(losses) / len(losses), {"drawn": max(drawn)}

    def _update(self, iteration: int, step: int) -> tuple[str, ...]:
        """Step the optimizer and densify; return events. No graph of `_gradients` may be alive."""
        optimizer = self._optimizer
        optimizer.check(iteration)
        length = self._budget.iterations
        # Skipped steps count as done, so that learning rates do not rise when a run is stopped.
        iterations = round(length * iteration / max(1, step - self.skipped))
        pace = Pace.of(self._options.learning_rates, iterations, length)
        with self._stage("optimizer"):
            optimizer.step(step, pace)
            self.corrections.center()
        with self._stage("adapt"), torch.no_grad():
            passed = range(self.step + 1, step + 1)  # each schedule step densifies once
            events = tuple(event for one in passed for event in self._model.adapt(one, optimizer.adam))
        return events + (self.corrections.summary() if step == length else ())

    def state(self) -> State:
        """Copy model, optimizer, statistics, random state and data order; to be taken between two records."""
        model, order = self._model.state(), self._order.state()
        tensors = {f"{MODEL}{name}": tensor for name, tensor in model.tensors.items()}
        tensors |= {f"{VIEWS}{name}": tensor for name, tensor in self.corrections.state_dict().items()}
        tensors |= self._optimizer.tensors() | {"random/torch": torch.get_rng_state()} | order.tensors
        values = {"model": model.values, **{name: getattr(self, name) for name in self.PROGRESS}, **order.values}
        values |= {name: copy.deepcopy(getattr(self, f"_{name}").state) for name in ("monitor", "early_stopping")}
        return State({name: tensor.detach().clone() for name, tensor in tensors.items()}, values)

    def load_state(self, state: State) -> None:
        """Resume where `state` was taken; raises ValueError if it is of a run on other data."""
        self._order.load(state)
        self._model.load_state(state.of_model())
        self.corrections.load_state_dict(state.under(VIEWS))
        self._optimizer.load(state)
        torch.set_rng_state(state.tensors["random/torch"].cpu())
        for name in {*self.PROGRESS} - {"schedule"}:  # that of this budget
            setattr(self, name, state.values[name])
        for name in ("monitor", "early_stopping"):
            getattr(self, f"_{name}").state = copy.deepcopy(state.values[name])


def background(iteration: int, seed: int) -> list[float]:
    """Return the random colour of an iteration; without a state, so that a resumed run goes on alike."""
    number = (iteration + 1_000_003 * seed) % 2**32  # the generator ignores higher bits
    return torch.rand(3, generator=torch.Generator().manual_seed(number)).tolist()
