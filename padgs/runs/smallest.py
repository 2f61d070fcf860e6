"""Search for the smallest model that is as good as that of a finished run: its minimal Gaussian count.

The search is a bisection over `budget.gaussians`. Each candidate is an ordinary run in RUN/smallest: it starts from the
model of RUN (`init`), prunes the least important Gaussians or anchors, and refines the others (`train.refine`) for 4 %
of the iterations, without the validation views (`train.hold_out`).

The validation views decide. RUN was trained on them; a candidate forgets them in part, and gains from more training.
So it is compared with the control, which is refined likewise and keeps all Gaussians. The smallest model is the
smallest candidate that is not inferior to the control.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from padgs import results
from padgs.clock import Lap, timed
from padgs.evaluation.evaluate import evaluate
from padgs.evaluation.images import to_uint8
from padgs.evaluation.metrics import BANDS
from padgs.evaluation.protocols import PROTOCOLS
from padgs.methods.splats.importance import importance_scores
from padgs.results import SMALLEST_LOSSES, SMALLEST_PICTURE, SMALLEST_PICTURED, Result, Scores
from padgs.runs.config import BudgetOptions, RunConfig
from padgs.runs.console import MISSING, number, say
from padgs.runs.interrupt import Interrupt
from padgs.runs.load import LoadedRun, load_run
from padgs.runs.run import Callback, run, start
from padgs.runs.store import Labels
from padgs.runs.warm_start import WarmStart
from padgs.training.health import held_out
from padgs.training.schedule import Pace

EXPERIMENT = FOLDER = "smallest"
RULES = PROTOCOLS["sphere"]
QUALITY, PERCEPTION = "ws_psnr", str(RULES.lpips_name)
TEST_RULES = replace(RULES, lpips="none")  # the test views decide nothing
REFINED = 0.04  # share of the run's iterations in a refinement
FRAMES = 10  # timed; the smallest time counts, since other programs only add to it
STEP = 0.7  # share of the rows that each candidate keeps of the last one until the largest loss is exceeded
CLOSE = 1.2  # the bisection ends at this ratio of two counts
MIN_ROWS = 10
CONFIDENCE, MAX_LPIPS_RISE = 0.95, 0.005
BAND, WORST = 2.0, 5.0  # a latitude band may lose so many epsilons on average, a view so many
SLOPE, OCTAVE = 0.1, 0.5  # knee: dB per halving, measured over at least this part of a halving


@dataclass(frozen=True)
class Candidate:
    """A pruned and refined model, measured."""

    run: str
    rows: int  # Gaussians, or anchors
    blended: int  # Gaussians that contribute to any training view
    bytes: int
    frame_ms: float  # the shortest of some frames
    scores: Scores  # of the validation views
    test_ws_psnr: float | None  # of the test views, which decide nothing
    seconds: float  # of pruning, refinement and measuring
    cpu_seconds: float


def objections(candidate: Scores, control: Scores, epsilon: float) -> tuple[str, ...]:
    """Return why a candidate is inferior to the control by more than `epsilon` dB; empty if it is not.

    It is not inferior if the one-sided 95 % bound of the mean paired difference of WS-PSNR over the views is above
    -epsilon, the mean difference in each latitude band above -2 epsilon, that of each view above -5 epsilon, and
    spherical LPIPS rises by at most 0.005 (if it can be measured).
    """
    changes, found = differences(candidate, control, QUALITY), []
    if not (bound := lower_bound(changes)) > -epsilon:
        found.append(f"WS-PSNR may fall by {-bound:.2f} dB")
    if not min(changes) > -WORST * epsilon:
        found.append(f"a view falls by {-min(changes):.2f} dB")
    for band in BANDS:
        of_band = differences(candidate, control, f"{QUALITY}_{band}")
        if of_band and not (mean := float(np.mean(of_band))) > -BAND * epsilon:
            found.append(f"{band} falls by {-mean:.2f} dB")
    rises = differences(candidate, control, PERCEPTION)
    if rises and not (rise := float(np.mean(rises))) <= MAX_LPIPS_RISE:
        found.append(f"LPIPS rises by {rise:.4f}")
    return tuple(found)


def differences(candidate: Scores, control: Scores, metric: str) -> list[float]:
    """Return candidate minus control for each view that both have the metric of; 0 where both are perfect."""
    pairs = [(candidate.views[name].get(metric), view.get(metric)) for name, view in control.views.items()]
    return [0.0 if new == old else new - old for new, old in pairs if new is not None and old is not None]


def lower_bound(changes: Sequence[float]) -> float:
    """Return the one-sided 95 % confidence bound of the mean of paired differences, by Student's t.

    >>> round(lower_bound([0.1, 0.0, -0.1]), 3), lower_bound([0.0, 0.0, 0.0])
    (-0.169, 0.0)
    """
    from scipy.stats import t

    spread = np.std(changes, ddof=1) / math.sqrt(len(changes))
    return float(np.mean(changes) - t.ppf(CONFIDENCE, len(changes) - 1) * spread)


def loss(candidates: Sequence[Candidate], candidate: Candidate) -> float:
    """Return the mean WS-PSNR in dB that a candidate loses against the control on the validation views."""
    return float(np.mean(differences(candidates[0].scores, candidate.scores, QUALITY)))


def smallest(candidates: Sequence[Candidate], epsilon: float) -> Candidate:
    """Return the smallest candidate that is not inferior; the first one is the control."""
    good = (c for c in candidates if not objections(c.scores, candidates[0].scores, epsilon))
    return min(good, key=lambda candidate: candidate.rows)


def next_count(candidates: Sequence[Candidate], losses: Sequence[float]) -> int | None:
    """Return the count of the next candidate; None if the smallest model of each loss is known.

    Counts fall until the largest loss is exceeded. Then, for each loss, the interval between the smallest model and
    the next smaller candidate is halved in log N.
    """
    counts = [candidate.rows for candidate in candidates]
    down = math.ceil(STEP * min(counts))
    if smallest(candidates, max(losses)).rows == min(counts) and MIN_ROWS <= down < min(counts):
        return down
    for epsilon in sorted(losses, reverse=True):
        rows = smallest(candidates, epsilon).rows
        below = max((count for count in counts if count < rows), default=rows)
        middle = round(math.sqrt(rows * below))
        if rows > CLOSE * below and below < middle < rows:
            return middle
    return None


def knee(candidates: Sequence[Candidate]) -> Candidate | None:
    """Return the largest candidate below which a halving costs more than 0.1 dB; None if none does."""
    order = sorted(candidates, key=lambda candidate: -candidate.rows)
    for one in order:
        lower = next((other for other in order if other.rows <= 2**-OCTAVE * one.rows), None)
        if lower is not None:
            fall = loss(candidates, lower) - loss(candidates, one)
            if fall / math.log2(one.rows / lower.rows) > SLOPE:
                return one
    return None


class Search:
    """The search on a finished run."""

    def __init__(self, run: LoadedRun, console: Console, stop_requested: Callable[[], bool] = lambda: False) -> None:
        """Prepare the search; `stop_requested` is asked besides signals.

        Raises:
            ValueError: the model has no Gaussians that could be pruned, or the scene has too few training views.
            DataError: the data set has changed since training.
        """
        assert run.result is not None, "only a finished run is searched"
        run.method.refuse_search()
        run.refuse_other_data()
        self.run, self._result, self._stop_requested = run, run.result, stop_requested
        self._console = console
        self._load = partial(load_run, data_path=run.config.data.path, device=run.config.run.device)
        self.views, self.validation = held_out(run.scene.train)
        self.row, self.rows = next(iter(run.method.model.counts().items()))
        self.candidates: list[Candidate] = []

    def complete(self) -> None:
        """Train and measure all candidates; a new search resumes one that was interrupted."""
        with Interrupt(self._stop_requested) as stop:
            count: int | None = self.rows
            while count is not None:
                self.candidates.append(self._candidate(count, lambda: stop.requested))
                one = self.candidates[-1]
                say(
                    self._console,
                    f"{len(self.candidates):3d} {one.rows:8d} {self.row}, {one.blended} Gaussians blended, "
                    f"{loss(self.candidates, one):5.2f} dB lost, {one.seconds:.1f} s",
                )
                count = next_count(self.candidates, SMALLEST_LOSSES)

    def _candidate(self, count: int, stop_requested: Callable[[], bool]) -> Candidate:
        """Train and measure a model of `count` rows, unless an earlier search did."""
        lap, folder = Lap(), self.run.folder / FOLDER
        result = self._trained(self._config(count, str(folder), hold_out=True), stop_requested)
        if not result.smallest:
            loaded = self._load(folder / result.run)
            measured = self._measured(loaded)
            measured["test_ws_psnr"] = result.scores[RULES.name].metrics[QUALITY] if result.scores else None
            measured["seconds"], measured["cpu_seconds"] = lap.seconds()
            with loaded.files:
                result = loaded.files.finish(replace(result, smallest=measured))
        values: dict[str, Any] = {**result.smallest, "scores": Scores(**result.smallest["scores"])}
        return Candidate(**values)

    def _measured(self, run: LoadedRun) -> dict[str, Any]:
        views, scene, device = islice(cycle(self.validation), FRAMES), self.run.scene, self.run.scene.points.device
        times = [timed(lambda view=view: run.method.render(view), device)[1] for view in views]
        scores = evaluate(run.method.render, self.validation, RULES)
        return {
            "run": run.folder.name,
            "rows": next(iter(run.method.model.counts().values())),
            "blended": importance_scores(run.method.model, scene.train).blended,
            "bytes": run.method.size().bytes,
            "frame_ms": 1000 * min(times),
            "scores": asdict(replace(scores, protocol={}, notes=())),
        }

    def keep(self, epsilon: float) -> Result:
        """Search, and keep the smallest model for a loss, refined on all training views, as a run beside RUN.

        Returns the result of RUN, with what was found in `smallest`.
        """
        self.complete()
        count = smallest(self.candidates, epsilon).rows
        config = self._config(count, str(self.run.folder.resolve().parent), hold_out=False)
        variant = ", ".join(filter(None, (self.run.config.variant, f"smallest {epsilon:g} dB")))
        labels = Labels(config.labels.preset, (EXPERIMENT,))
        config = replace(config, variant=variant, labels=labels, protocols=self.run.config.protocols)
        kept = self._trained(config, self._stop_requested)
        if self.run.scene.test:
            self._save_picture(self.run.folder / SMALLEST_PICTURE)
        found = self.front() | {"kept": {"epsilon": epsilon, "run": kept.run}}
        result = self.run.files.result() or self._result  # other commands may have added experiments or scores
        served = results.joined(result.experiments, (EXPERIMENT,))
        return self.run.files.finish(replace(result, smallest=found, experiments=served))

    def front(self) -> dict[str, Any]:
        """Return what the search found, for `Result.smallest`.

        Returns:
            row: gaussians or anchors; rows: of the searched run; test_ws_psnr: of the searched run; minimal: epsilon ->
            index of the smallest model; knee: index, or None; steps: all candidates, the control first, each with its
            loss against the control and the objections at each epsilon; validation: names of views; seconds,
            cpu_seconds: of all candidates.
        """
        found, bend, test = self.candidates, knee(self.candidates), self.run.scene.test
        return {
            "row": self.row,
            "rows": self.rows,
            "test_ws_psnr": evaluate(self.run.method.render, test, TEST_RULES).metrics[QUALITY] if test else None,
            "minimal": {f"{e:g}": found.index(smallest(found, e)) for e in SMALLEST_LOSSES},
            "knee": None if bend is None else found.index(bend),
            "steps": [self._described(one) for one in found],
            "validation": [view.name for view in self.validation],
            "seconds": math.fsum(one.seconds for one in found),
            "cpu_seconds": math.fsum(one.cpu_seconds for one in found),
        }

    def _described(self, one: Candidate) -> dict[str, Any]:
        values, metrics, control = asdict(one), one.scores.metrics, self.candidates[0].scores
        del values["scores"]
        values |= {"loss": loss(self.candidates, one), "ws_psnr": metrics[QUALITY], "lpips": metrics.get(PERCEPTION)}
        return values | {"objections": {f"{e:g}": list(objections(one.scores, control, e)) for e in SMALLEST_LOSSES}}

    def _config(self, count: int, folder: str, hold_out: bool) -> RunConfig:
        """Return the configuration of the run that prunes to `count` rows and refines them."""
        config = self.run.config
        schedule = self.run.method.state().values["schedule"]  # of a budget of seconds it is known afterwards
        train = replace(
            config.train,
            iterations=max(len(self.views), round(REFINED * schedule)),
            learning_rates=Pace.of(config.train.learning_rates, schedule).factor,
            refine=True,
            hold_out=hold_out,
            max_seconds=None,
            monitor=False,  # in so few iterations, views that differ look like divergence
            guard_scales=False,  # whose bounds are relative to the beginning of a run
        )
        return replace(
            config,
            train=train,
            budget=BudgetOptions(gaussians=None if count == self.rows else count),
            init=WarmStart.of(str(self.run.folder), config.method),
            run=replace(config.run, folder=folder, pictures=config.run.pictures and not hold_out, view=False),
            protocols={RULES.name: TEST_RULES},
            labels=Labels(self._result.preset),
        )

    def _trained(self, config: RunConfig, stop_requested: Callable[[], bool]) -> Result:
        start(config)
        callback = Callback()
        callback.stop_requested = stop_requested  # type: ignore[method-assign]
        result = run(config, Console(quiet=True), callback, self.run.scene)
        if not result.ok:
            raise ValueError(f"{config.run.folder}/{result.run} ended with status {result.status} ({result.reason})")
        return result

    @torch.no_grad()
    def _save_picture(self, path: Path) -> None:
        """Save the middle test view: ground truth, the render of RUN, those of the smallest models for two losses."""
        view = self.run.scene.test[len(self.run.scene.test) // 2]
        runs = (smallest(self.candidates, epsilon).run for epsilon in SMALLEST_PICTURED)
        methods = (self.run.method, *(self._load(self.run.folder / FOLDER / run).method for run in runs))
        images = [view.image(), *(method.render(view).image for method in methods)]
        Image.fromarray(np.concatenate([to_uint8(image) for image in images], axis=1)).save(path)


def find_smallest(
    run: LoadedRun, epsilon: float, console: Console, stop_requested: Callable[[], bool] = lambda: False
) -> Result:
    """Search the smallest model that loses at most `epsilon` dB, keep it as a run beside RUN, and print the table.

    Args:
        run: a finished run.
        epsilon: one of `padgs.results.SMALLEST_LOSSES`.
        console: receives progress and the table.
        stop_requested: is asked whether to stop, besides signals.

    Raises:
        ValueError: the run cannot be searched, or a candidate failed.
        RunBusy: another process searches it.
        Interrupted: stopped from outside; a new search resumes.
    """
    with run.files:
        result = Search(run, console, stop_requested).keep(epsilon)
    show(result.smallest, console)
    say(console, run.folder.resolve().with_name(result.smallest["kept"]["run"]), "bold")
    return result


def show(found: dict[str, Any], console: Console) -> None:
    """Print the smallest model for each loss, the knee, and the cost of the search."""
    steps = found["steps"]
    table = Table("may lose", box=SIMPLE_HEAD)
    for column in (found["row"], "of all", "blended", "MB", "ms", "lost, dB", "test dB"):
        table.add_column(column, justify="right")
    rows = {"control": 0, **{f"{epsilon} dB": at for epsilon, at in found["minimal"].items()}, "knee": found["knee"]}
    for title, at in rows.items():
        if at is None:
            table.add_row(title, *[MISSING] * 7)
            continue
        step = steps[at]
        share, size = f"{100 * step['rows'] / found['rows']:.0f} %", f"{step['bytes'] / 1e6:.2f}"
        quality = f"{step['loss']:.2f}", number("psnr", step["test_ws_psnr"])
        table.add_row(title, str(step["rows"]), share, str(step["blended"]), size, f"{step['frame_ms']:.1f}", *quality)
    console.print(table)
    console.print(
        f"Decided by {len(found['validation'])} validation views. The search took {found['seconds']:.0f} s, "
        f"{found['cpu_seconds']:.0f} s of CPU time."
    )
