"""The search for the smallest model of a run, step after step of `padgs.need.plan`, resumable at any iteration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import cycle, islice

import torch

from padgs.clock import Lap, timed
from padgs.evaluation.evaluate import evaluate
from padgs.methods.splats.importance import importance_scores, most_important
from padgs.methods.splats.model import SplatModel
from padgs.need import refine
from padgs.need.calibration import RULES, calibration_split
from padgs.need.plan import Plan, Step, loss, narrowest, plan, plan_degree, smallest
from padgs.need.refine import Refining
from padgs.need.steps import StepsFolder
from padgs.results import Scores
from padgs.runs import checkpoint
from padgs.runs.interrupt import Interrupt, Interrupted
from padgs.runs.load import LoadedRun
from padgs.scene import View
from padgs.training.loop import Trainer
from padgs.training.model import Prunable, State
from padgs.training.options import Budget

FOLDER = "need"  # in that of the run
FRAMES = 10  # timed; the smallest time counts, since other programs only add to it
WITHOUT_PERCEPTION = replace(RULES, lpips="none")  # for test views, which decide nothing


class Search:
    """The steps of a run, those that were made before included.

    Attributes:
        run: whose model is looked at.
        calibration: training views that are measured on.
        row: what a row of the model is called, gaussians or anchors.
        rows: how many the model of the run has.
        steps, folder: what was made so far, and where it is.
    """

    def __init__(
        self,
        run: LoadedRun,
        say: Callable[[str], None] = lambda text: None,
        asked: Callable[[], bool] = lambda: False,
    ) -> None:
        """Prepare; nothing is drawn yet.

        Args:
            run: whose model is looked at.
            say: is told of each step.
            asked: whether to stop, besides signals.

        Raises:
            ValueError: the model has no Gaussians that could be left out, or the scene too few training views.
            CheckpointError: steps of an earlier start are damaged, or of another model.
        """
        self.run, self._say, self._asked = run, say, asked
        self.calibration, self._views = calibration_split(run.scene.train)
        self._model = self._resumed()
        self.row, self.rows = next(iter(self._model.counts().items()))
        self.folder = StepsFolder(run.folder / FOLDER, checkpoint.digest(run.files.checkpoint))
        self.steps = self.folder.steps()

    def complete(self, epsilon: float) -> int:
        """Make all steps that are missing; returns the one to keep.

        That is the smallest model as good as its control up to epsilon, with as few harmonics as are as good as all.

        Raises:
            Interrupted: stopped from outside; starting again goes on, to the same result bit by bit (on the CPU).
            Failure: a refinement failed.
        """
        if self.steps:
            self._say(f"{len(self.steps)} steps were made before")
        self._make_all(lambda: plan(self.steps))
        number = smallest(self.steps, epsilon)
        if isinstance(self._model, SplatModel):
            degree = self._model.splats.degree
            self._make_all(lambda: plan_degree(self.steps, number, degree, epsilon))
        return narrowest(self.steps, number, epsilon)

    def _make_all(self, following: Callable[[], Plan | None]) -> None:
        with Interrupt(self._asked) as stop:
            while (wanted := following()) is not None:
                step, model = self._make(wanted, stop)
                self.folder.add(len(self.steps), step, model)
                self.steps.append(step)
                kind = step.kind if step.degree is None else f"{step.kind} {step.degree}"
                self._say(
                    f"{len(self.steps):3d} {kind:8s} {step.rows:8d} {self.row}, {step.blended} Gaussians blended, "
                    f"{loss(self.steps, len(self.steps) - 1):5.2f} dB lost, {step.seconds:.1f} s"
                )
                if stop.requested:
                    raise Interrupted(f"stopped after step {len(self.steps)}; nothing is lost, start again to go on")

    def kept(self, number: int) -> tuple[Prunable, tuple[float, float]]:
        """The model of a step, refined once more on all training views if it was refined without some.

        Returns:
            The model, and the seconds that this took: of wall and of CPU time.

        Raises:
            Interrupted, Failure: as `complete` does.
        """
        lap, before, model = Lap(), (0.0, 0.0), self.model_of(number)
        if self.steps[number].depth > 0:
            with Interrupt(self._asked) as stop:
                before = self._refine(model, self.run.scene.train, f"kept {number}", number, stop)
        return model, _in_all(before, lap)

    def model_of(self, number: int) -> Prunable:
        """The model of a step."""
        model, state = self._resumed(), self.folder.state(number, self._device)
        if isinstance(model, SplatModel) and (degree := self.steps[number].degree) is not None:
            model.truncate(degree)
        model.load_state(State(state.tensors, state.values["model"]))
        return model

    @property
    def _device(self) -> torch.device:
        return self.run.scene.points.device

    @property
    def _schedule(self) -> int:
        """Iterations of the run's schedule; those of a budget of seconds are known afterwards."""
        return self.run.method.state().values.get("schedule", self.run.config.train.iterations)

    def _resumed(self) -> Prunable:
        """The model of the run."""
        self.run.method.refuse_search()
        model = self.run.method.resumed(self.run.scene, self._schedule)
        if not isinstance(model, Prunable):
            raise ValueError(
                f"{self.run.config.method} has no Gaussians that could be left out; take a method that has"
            )
        return model

    def _make(self, wanted: Plan, stop: Interrupt) -> tuple[Step, State]:
        lap, before, number = Lap(), (0.0, 0.0), len(self.steps)
        model = self._model if wanted.parent is None else self.model_of(wanted.parent)
        if wanted.kind == "waste":
            shown = importance_scores(model, self.run.scene.train).peak > 0
            model.keep(shown)
        else:
            if isinstance(model, SplatModel) and wanted.degree is not None:
                model.truncate(wanted.degree)
            if wanted.rows is not None:
                model.keep(most_important(importance_scores(model, self.run.scene.train), wanted.rows))
            before = self._refine(model, self._views, f"step {number}: {wanted}", number, stop)
        step = self._measured(model, wanted)
        seconds, cpu_seconds = _in_all(before, lap)
        return replace(step, seconds=seconds, cpu_seconds=cpu_seconds), model.state()

    def _refine(
        self, model: Prunable, views: tuple[View, ...], what: str, number: int, stop: Interrupt
    ) -> tuple[float, float]:
        """Train a model a little on some views, in the order that belongs to the number of a step.

        `what` says all that decides the outcome: an interrupted refinement goes on if it is that of the same. Returns
        the seconds, of wall and of CPU time, that it had taken before.
        """
        config, seed = self.run.config, self.run.config.seed + number
        # In so few iterations views that differ look like a sign; bounds of scales are of the beginning of a run.
        options = replace(config.train, monitor=False, guard_scales=False)
        count = max(len(views), round(refine.SHARE * self._schedule))
        refining = Refining(model, options, self._schedule, count)
        torch.manual_seed(seed)
        trainer = Trainer(refining, replace(self.run.scene, train=views), Budget(count), options, seed)
        if (begun := self.folder.begun(what, self._device)) is not None:
            trainer.load_state(begun)
        before = trainer.seconds, trainer.cpu_seconds
        for record in trainer.records():
            if stop.requested and record.iteration < count:
                self.folder.begin(what, trainer.state())
                raise Interrupted("stopped within a refinement; nothing is lost, start again to go on")
        return before

    def scored(self, model: Prunable) -> tuple[Scores, dict[str, float | None]]:
        """Marks of the calibration views, and means of the test views, which decide nothing."""
        test = self.run.scene.test
        marks = replace(evaluate(model.render, self.calibration, RULES), protocol={}, notes=())
        return marks, evaluate(model.render, test, WITHOUT_PERCEPTION).metrics if test else {}

    def _measured(self, model: Prunable, wanted: Plan) -> Step:
        scene = self.run.scene
        marks, test = self.scored(model)
        views = islice(cycle(self.calibration), FRAMES)
        times = [timed(lambda view=view: model.render(view), self._device)[1] for view in views]
        return Step(
            kind=wanted.kind,
            parent=wanted.parent,
            depth=0 if wanted.parent is None else self.steps[wanted.parent].depth + 1,
            rows=next(iter(model.counts().values())),
            blended=importance_scores(model, scene.train).blended,
            bytes=model.size().bytes,
            frame_ms=1000 * min(times),
            marks=marks,
            test=test,
            degree=wanted.degree,
        )


def _in_all(before: tuple[float, float], lap: Lap) -> tuple[float, float]:
    """Seconds of wall and of CPU time: those before an interruption, and those since the lap began."""
    wall, cpu = lap.seconds()
    return before[0] + wall, before[1] + cpu
