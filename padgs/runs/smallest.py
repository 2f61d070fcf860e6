"""Search for the smallest model that is as good as that of a finished run: its minimal Gaussian count.

The search is a bisection over `budget.gaussians`. Each candidate is an ordinary run in RUN/smallest: it starts from the
model of RUN (`init`), prunes the least important Gaussians or anchors, and refines the others (`train.refine`) for 4 %
of the iterations.

The test views decide, because RUN was trained on all others: of these a smaller model forgets what it knew by heart,
whether a view in between needs it or not (docs/smallest.md). A candidate gains from more training, so it is compared
with the control, which is refined likewise and keeps all Gaussians. The smallest model is the smallest candidate that
is not inferior to the control.
"""

import math
import os
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from itertools import cycle, islice
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Column, Table

from padgs import results
from padgs.clock import Lap, machine, timed
from padgs.evaluation.evaluate import evaluate
from padgs.evaluation.protocols import PROTOCOLS
from padgs.methods.splats.importance import importance_scores
from padgs.results import SMALLEST_LOSSES, Result
from padgs.runs import candidates
from padgs.runs.config import BudgetOptions, RunConfig
from padgs.runs.console import MISSING, number, say
from padgs.runs.interrupt import Interrupt
from padgs.runs.load import LoadedRun, load_run
from padgs.runs.run import Callback, run, start
from padgs.runs.store import Labels
from padgs.runs.warm_start import WarmStart
from padgs.training.schedule import Pace

EXPERIMENT = FOLDER = "smallest"
RULES = PROTOCOLS["sphere"]
REFINED = 0.04  # share of the run's iterations in a refinement
FRAMES = 10  # timed; the smallest time counts, since other programs only add to it


class Search:
    """The search on a finished run."""

    def __init__(self, run: LoadedRun, console: Console, stop_requested: Callable[[], bool] = lambda: False) -> None:
        """Prepare the search; a ValueError says why it cannot be. `stop_requested` is asked besides signals."""
        assert run.result is not None, "only a finished run is searched"
        run.method.refuse_search()
        run.refuse_other_data()
        self.run, self._result, self._stop_requested = run, run.result, stop_requested
        self._console = console
        self._load = partial(load_run, data_path=run.config.data.path, device=run.config.run.device)
        self.views = candidates.deciding_views(run.scene)
        self.shares = {view.name: candidates.band_shares(view) for view in self.views if view.lens is None}
        self.row, self.rows = next(iter(run.method.model.counts().items()))
        self.candidates: list[candidates.Candidate] = []

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
                    f"{candidates.loss(self.candidates, one):5.2f} dB lost, {one.seconds:.1f} s",
                )
                count = candidates.next_count(self.candidates, SMALLEST_LOSSES, self.shares)

    def _candidate(self, count: int, stop_requested: Callable[[], bool]) -> candidates.Candidate:
        """Train and measure a model of `count` rows, unless an earlier search did."""
        lap, folder = Lap(), self.run.folder / FOLDER
        result = self._trained(self._config(count, str(folder)), stop_requested)
        if not result.smallest:
            loaded = self._load(folder / result.run)
            measured = self._measured(loaded)
            # Training may have been interrupted, and this process is then only the last of several.
            spent = zip(lap.seconds(), (result.timing[f"{of}_seconds"] for of in ("train", "cpu")), strict=True)
            measured["seconds"], measured["cpu_seconds"] = map(max, spent)
            with loaded.files:
                result = loaded.files.finish(replace(result, smallest=measured))
        return candidates.Candidate(**result.smallest, scores=result.scores[RULES.name])

    def _measured(self, run: LoadedRun) -> dict[str, Any]:
        scene, device = self.run.scene, self.run.scene.points.device
        views = islice(cycle(scene.test), FRAMES)
        times = [timed(lambda view=view: run.method.render(view), device)[1] for view in views]
        return {
            "run": run.folder.name,
            "rows": next(iter(run.method.model.counts().values())),
            "blended": importance_scores(run.method.model, scene.train).blended,
            "bytes": run.method.size().bytes,
            "frame_ms": 1000 * min(times),
        }

    def keep(self, epsilon: float) -> Result:
        """Search, and keep the smallest model for a loss, refined, as a run beside RUN; return RUN's result."""
        self.complete()
        count = candidates.smallest(self.candidates, epsilon, self.shares).rows
        config = self._config(count, str(self.run.folder.resolve().parent))
        variant = ", ".join(filter(None, (self.run.config.variant, f"smallest {epsilon:g} dB")))
        labels = Labels(config.labels.preset, (EXPERIMENT,))
        config = replace(config, variant=variant, labels=labels, protocols=self.run.config.protocols)
        options = replace(config.run, pictures=self.run.config.run.pictures)
        kept = self._trained(replace(config, run=options), self._stop_requested)
        found = self.front() | {"kept": {"epsilon": epsilon, "run": kept.run}}
        result = self.run.files.result() or self._result  # other commands may have added experiments or scores
        served = results.joined(result.experiments, (EXPERIMENT,))
        return self.run.files.finish(replace(result, smallest=found, experiments=served))

    def front(self) -> dict[str, Any]:
        """Return what the search found, for `Result.smallest`.

        Returns:
            row: gaussians or anchors; machine: the one that searched; rows, ws_psnr: of the searched run;
            minimal, possible: epsilon -> index of `smallest`, `smallest_possible`; steps: all candidates, the control
            first, each with its loss against the control and the objections at each epsilon; views: names of those
            that decide;
            seconds, cpu_seconds: of all candidates.
        """
        found = self.candidates
        whole = evaluate(self.run.method.render, self.run.scene.test, replace(RULES, lpips="none"))
        return {
            "row": self.row,
            "machine": machine(self.run.scene.points.device),
            "rows": self.rows,
            "ws_psnr": whole.metrics[candidates.QUALITY],
            "minimal": {f"{e:g}": found.index(candidates.smallest(found, e, self.shares)) for e in SMALLEST_LOSSES},
            "possible": {f"{e:g}": found.index(candidates.smallest_possible(found, e)) for e in SMALLEST_LOSSES},
            "steps": [self._described(one) for one in found],
            "views": [view.name for view in self.views],
            "seconds": math.fsum(one.seconds for one in found),
            "cpu_seconds": math.fsum(one.cpu_seconds for one in found),
        }

    def _described(self, one: candidates.Candidate) -> dict[str, Any]:
        values, metrics, control = asdict(one), one.scores.metrics, self.candidates[0].scores
        del values["scores"]
        values |= {"loss": candidates.loss(self.candidates, one), "ws_psnr": metrics[candidates.QUALITY]}
        values |= {"lpips": metrics.get(candidates.PERCEPTION)}
        found = {f"{e:g}": list(candidates.objections(one.scores, control, e, self.shares)) for e in SMALLEST_LOSSES}
        return values | {"objections": found}

    def _config(self, count: int, folder: str) -> RunConfig:
        """Return the configuration of the run that prunes to `count` rows and refines them."""
        config, views = self.run.config, len(self.run.scene.train)
        schedule = self.run.method.state().values["schedule"]  # of a budget of seconds it is known afterwards
        train = replace(
            config.train,
            iterations=max(views, round(REFINED * schedule)),
            learning_rates=Pace.of(self.run.method.train_options.learning_rates, schedule).factor,
            refine=True,
            max_seconds=None,
            monitor=False,  # in so few iterations, views that differ look like divergence
        )
        return replace(
            config,
            train=train,
            budget=BudgetOptions(gaussians=None if count == self.rows else count),
            init=WarmStart.of(str(self.run.folder), config.method),
            run=replace(config.run, folder=folder, pictures=False),
            protocols={RULES.name: RULES},
            labels=Labels(self._result.preset),
            retry="failed",
        )

    def _trained(self, config: RunConfig, stop_requested: Callable[[], bool]) -> Result:
        start(config)
        callback = Callback()
        callback.stop_requested = stop_requested
        callback.is_candidate = True
        result = run(config, Console(quiet=True), callback, self.run.scene)
        if not result.ok:
            failed = f"{config.run.folder}/{result.run} ended with status {result.status} ({result.reason})"
            raise ValueError(f"{failed}; padgs smallest {self.run.folder} tries it again")
        return result


def find_smallest(
    run: LoadedRun, epsilon: float, console: Console, stop_requested: Callable[[], bool] = lambda: False
) -> Result:
    """Search the smallest model that loses at most `epsilon` dB, keep it as a run beside RUN, and print the table.

    `run` is finished, and `epsilon` one of `padgs.results.SMALLEST_LOSSES`. A ValueError says that the run cannot be
    searched or a candidate failed, RunBusy that another process searches it. A new search resumes after `Interrupted`.
    """
    with run.files:
        result = Search(run, console, stop_requested).keep(epsilon)
    show(result.smallest, console)
    kept = run.folder.resolve().with_name(result.smallest["kept"]["run"])
    say(console, kept if run.folder.is_absolute() else os.path.relpath(kept), "bold")
    return result


def show(found: dict[str, Any], console: Console) -> None:
    """Print the smallest model for each loss, and the cost of the search."""
    steps = found["steps"]
    table = Table(Column("loss", no_wrap=True), box=SIMPLE_HEAD, pad_edge=False)
    for column in (found["row"], "interval", "MB", "ms", "dB lost", "dB"):
        table.add_column(column, justify="right", no_wrap=True)
    titled = {"control": 0, **{f"{epsilon} dB": at for epsilon, at in found["minimal"].items()}}
    for title, at in titled.items():
        step, epsilon = steps[at], title.removesuffix(" dB")
        least = found["possible"].get(epsilon)
        interval = MISSING if least is None else f"{min(steps[least]['rows'], step['rows'])}–{step['rows']}"
        costs = f"{step['bytes'] / 1e6:.2f}", f"{step['frame_ms']:.1f}"
        quality = f"{step['loss']:.2f}", number("psnr", step["ws_psnr"])
        table.add_row(title, str(step["rows"]), interval, *costs, *quality)
    console.print(table)
    console.print(
        f"Decided by {len(found['views'])} test views; interval: with 90 % confidence. The search took "
        f"{found['seconds']:.0f} s, {found['cpu_seconds']:.0f} s of CPU time."
    )
