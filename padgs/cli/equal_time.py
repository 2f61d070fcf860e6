"""`padgs equal-time`: how long each method has to be trained for all of them to take the same time."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from padgs import results
from padgs.cli.refusing import refusing
from padgs.results import Result
from padgs.runs.typed import ConfigError
from reports.frame import frame, hardware, machine
from reports.gathered import Gathered
from reports.request import Request
from reports.store import Run
from reports.tables.equal_time import EXPERIMENT, is_near
from reports.tables.table import ReportError


@refusing(ReportError)
def equal_time(
    runs: Annotated[str, typer.Argument(help="folder of run folders, with a finished run of each method")],
    seconds: Annotated[float, typer.Argument(help="of training, that every method shall take")],
    settings: Annotated[list[str] | None, typer.Argument(help="settings for all commands, e.g. tracking=none")] = None,
    experiment: Annotated[str, typer.Option(help="lengths are those of its runs, e.g. all_methods@cpu")] = "",
) -> None:
    """Print the commands that train every method of a folder for the same time; `| sh` runs them.

    The number of iterations comes from finished runs of the same settings, whatever their lengths. As models grow, time
    is not proportional to iterations: repeat it until nothing is printed.
    """
    folder = Path(runs)
    if not folder.is_dir():
        raise ReportError(f"there is no folder {folder}; give the folder of the runs")
    if not 0 < seconds < math.inf:
        raise ReportError(f"seconds is {seconds:g}; it must be > 0 and finite")
    found, broken = results.read_all(folder)
    for error in broken:
        print(f"left out: {error}", file=sys.stderr)
    methods = Gathered(frame(map(Run, found)), Request(experiment=experiment)).chosen("methods")
    by_name = {result.run: result for result in found}
    names = dict.fromkeys((*methods["run"], *(result.run for result in found if EXPERIMENT in result.experiments)))
    known = [by_name[name] for name in names]
    usable = [result for result in known if result.ok and not result.variant and result.timing.get("train_seconds")]
    if not usable:
        raise ReportError(
            f"no run in {folder} has ended well; run the methods first, "
            "e.g. padgs-run +experiment=all_methods scale=cpu"
        )
    machines = sorted({hardware(result) for result in usable})
    if len(machines) > 1:
        raise ReportError(
            f"the runs in {folder} are of several machines ({'; '.join(machines)}), whose times say nothing about each "
            "other; give a folder with the runs of one"
        )
    from hydra.errors import HydraException

    from padgs.multirun.composition import command, composing, settings_of

    with composing():
        for alike in lengths(usable):
            nearest, length = min(alike, key=lambda result: _distance(result, seconds)), iterations(alike, seconds)
            if any(result.iterations == length for result in alike):
                continue  # near enough, or as near as a whole number of iterations comes
            choices = (f"+experiment={EXPERIMENT}", f"method={nearest.preset}")
            try:
                given = settings_of(_values(nearest, folder, length), *choices)
            except (ConfigError, HydraException) as error:
                print(f"left out: {nearest.run}: {error}", file=sys.stderr)
                continue
            print(command([*given, *(settings or [])]))


def lengths(runs: Iterable[Result]) -> list[list[Result]]:
    """The runs in groups that differ in their length only; with as many threads each."""
    groups: dict[str, list[Result]] = {}
    for result in runs:
        config = results.decisive(result.config)
        config["train"] = {key: value for key, value in config["train"].items() if key != "iterations"}
        key = [result.preset, result.fingerprint, machine(result), config]
        groups.setdefault(json.dumps(key, sort_keys=True), []).append(result)
    return list(groups.values())


def iterations(runs: Sequence[Result], seconds: float) -> int:
    """Iterations that take about `seconds`, by runs that differ in their length only.

    Those of a run that took about as long; else between the next shorter and the next longer run, where time is taken
    to grow as a power of the iterations; beyond all runs, in proportion to the nearest.
    """
    nearest = min(runs, key=lambda result: _distance(result, seconds))
    if is_near(_seconds(nearest), seconds):
        return nearest.iterations
    shorter = max((r for r in runs if _seconds(r) < seconds), key=_seconds, default=None)
    longer = min((r for r in runs if _seconds(r) > seconds), key=_seconds, default=None)
    if shorter is None or longer is None or shorter.iterations >= longer.iterations:
        return max(1, round(nearest.iterations * seconds / _seconds(nearest)))
    share = math.log(seconds / _seconds(shorter)) / math.log(_seconds(longer) / _seconds(shorter))
    return max(1, round(shorter.iterations * (longer.iterations / shorter.iterations) ** share))


def _distance(result: Result, seconds: float) -> float:
    return abs(math.log(_seconds(result) / seconds))


def _values(result: Result, folder: Path, length: int) -> dict[str, Any]:
    """The configuration of the run that is asked for."""
    config = result.config
    return {
        **config,
        "data": {key: value for key, value in config["data"].items() if key != "device"},  # follows run.device
        "train": {**config["train"], "iterations": length},
        "run": {**config["run"], "folder": str(folder)},
    }


def _seconds(result: Result) -> float:
    return result.timing["train_seconds"]
