"""All runs in one data frame, a row a run, from which every table, chart and CSV file is made.

Columns: what a run is (`place`, `preset`, `variant`, `seed`, ...) and how it went (`ok`, `status`); under what
conditions it was made (`resolution`, `data`, `machine`, `paper rules`, ...); its numbers (`paper/psnr`, `frame_ms`,
...), NaN where missing; and each key of its configuration (`config.train.iterations`), None where there is none.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any

import pandas as pd
from pandas import DataFrame

from padgs.reports.images_seen import images_seen
from padgs.reports.learning_rates import law
from padgs.reports.scenes import Place
from padgs.reports.store import Run
from padgs.results import BY_ITSELF, DECIDE_NOTHING, Result, Scores, picture_name

CONFIG = "config."  # and the dotted key
NO_SETTING = ("seed", *DECIDE_NOTHING)  # a section stands for all in it
INPUT_RANGES = {"01": "[0, 1]", "11": "[-1, 1]"}


def frame(runs: Iterable[Run]) -> DataFrame:
    """The runs in their order; the index counts them."""
    runs = list(runs)
    results = [run.result for run in runs]
    facts = DataFrame({name: [of(result) for result in results] for name, of in FACTS.items()}, dtype=object)
    facts["log"], facts["pictures"] = [run.log for run in runs], [run.pictures for run in runs]
    numbers = DataFrame({name: [of(result) for result in results] for name, of in NUMBERS.items()}, dtype=float)
    last = [run.log.get("polar_transmittance", ())[-1:] for run in runs]
    numbers["polar_transmittance"] = [value[0] if value else math.nan for value in last]
    numbers["train_hours"], numbers["fps"] = numbers["train_seconds"] / 3600, 1000 / numbers["frame_ms"]
    rules = _columns([dict(_rules(result)) for result in results], object)
    marks = _columns([dict(_marks(result)) for result in results], float)
    config = _columns([dict(_config(result.config)) for result in results], object).add_prefix(CONFIG)
    return pd.concat([facts.astype({"ok": bool}), rules, marks, numbers, config], axis=1)


def grouped(runs: DataFrame, *columns: str) -> list[tuple[tuple[Any, ...], DataFrame]]:
    """The runs that agree in some columns, and in what; in the order of the first of each."""
    groups: Any = runs.groupby(list(columns), sort=False)
    return list(groups)


def by_place(runs: DataFrame) -> dict[Place, DataFrame]:
    """The runs of each scene, in the order of the tables."""
    found = {place: own for (place,), own in grouped(runs, "place")}
    return {place: found[place] for place in sorted(found, key=lambda place: place.rank)}


def by_conditions(runs: DataFrame, *columns: str) -> dict[str, DataFrame]:
    """The runs of each scene that agree in some more columns, in the order of the tables, by what tells them apart."""
    found = {}
    for place, own in by_place(runs).items():
        for values, alike in grouped(own.sort_values(["resolution", "iterations"], kind="stable"), *columns):
            found[", ".join([place.title, *values])] = alike
    return found


def hardware(result: Result) -> str:
    """The machine in a few words, with the version of torch."""
    known = result.machine
    where = known.get("gpu") or f"{known.get('cores')} cores of {known.get('cpu')}"
    return f"{where}, torch {known.get('torch')}"


def machine(result: Result) -> str:
    """The same with the number of threads: what times depend on."""
    threads = result.machine.get("threads")
    return hardware(result) + (f", {threads} threads" if threads else "")


def decides(key: str) -> bool:
    """Whether runs that differ in a dotted key of their configurations are runs of different settings.

    >>> decides("train.iterations"), decides("run.threads")
    (True, False)
    """
    return not any(key == other or key.startswith(f"{other}.") for other in NO_SETTING)


FACTS: Mapping[str, Callable[[Result], Any]] = {
    **{
        name: attrgetter(name)
        for name in (
            *("run", "ok", "status", "method", "preset", "variant", "dataset", "scene", "seed", "iterations"),
            *("code_version", "finished", "need"),
        )
    },
    "experiments": lambda result: result.experiments or (BY_ITSELF,),
    "place": lambda result: Place(result.dataset, result.scene),
    "resolution": lambda result: f"{result.width}x{result.height}",
    "data": lambda result: result.fingerprint[:10],
    "length": lambda result: _length(result),
    "learning_rates": lambda result: _learning_rates(result),
    "hardware": hardware,
    "machine": machine,
    "setting": lambda result: json.dumps(
        {key: value for key, value in _config(result.config) if decides(key)}, sort_keys=True
    ),
    "view_psnr": lambda result: _view_psnr(result.scores),
}
NUMBERS: Mapping[str, Callable[[Result], float | None]] = {
    "iterations_done": lambda result: result.iterations_done,
    "images": images_seen,
    "train_seconds": lambda result: result.timing.get("train_seconds"),
    "cpu_seconds": lambda result: result.timing.get("cpu_seconds"),  # of the process, while training
    "frame_ms": lambda result: result.timing.get("render_ms_median"),  # over the test views, decoding included
    "anchors": lambda result: result.counts.get("anchors"),
    "start": lambda result: result.counts.get("start"),  # Gaussians or anchors before training
    "gaussians": lambda result: result.counts.get("gaussians"),  # none in a method without any
    "megabytes": lambda result: result.model_bytes / 1e6 or None,
    "peak_gigabytes": lambda result: result.peak_memory_bytes / 1e9 or None,  # of the process, while training
    "peak_gpu_gigabytes": lambda result: (result.peak_device_memory_bytes or math.nan) / 1e9,  # of the tensors there
}


def _columns(rows: Sequence[Mapping[str, Any]], dtype: type) -> DataFrame:
    """A column for each name in any of the rows; what a row does not have is None, or NaN among numbers."""
    names = dict.fromkeys(name for row in rows for name in row)
    return DataFrame({name: [row.get(name) for row in rows] for name in names}, index=range(len(rows)), dtype=dtype)


def _rules(result: Result) -> Iterator[tuple[str, str]]:
    """What is asked of each protocol, and what was done under it."""
    scored = {name: scores.protocol for name, scores in result.scores.items()}
    for name, rules in {**result.config.get("protocol", {}), **scored}.items():
        words = [name, f"LPIPS-{rules.get('lpips')} fed {INPUT_RANGES.get(rules.get('lpips_inputs', ''))}"]
        if rules.get("bottom_crop"):
            words.append(f"without the last {100 * rules['bottom_crop']:.1f} % of the rows")
        yield f"{name} rules", ", ".join(words)


def _marks(result: Result) -> Iterator[tuple[str, float | None]]:
    for name, scores in result.scores.items():
        for metric, value in scores.metrics.items():
            yield f"{name}/{metric}", value


def _length(result: Result) -> str:
    """How long a run was asked to be: iterations, or time."""
    budget = result.config.get("budget", {})
    if "seconds" not in budget:
        return f"{result.iterations} iterations"
    return f"{budget['seconds']:g} s{' of CPU time' if budget['clock'] == 'cpu' else ''}"


def _learning_rates(result: Result) -> Any:
    """The choice of `train.learning_rates`, as far as it decides anything; None for methods that have but one."""
    choice = result.config.get("train", {}).get("learning_rates", "published")  # older runs had no choice
    if result.method == "egonerf" or not result.iterations:  # one of seconds that failed before its first
        return None
    return "published" if choice == 1 or (choice == "run" and law(result.iterations) == 1) else choice


def _view_psnr(scores: Mapping[str, Scores]) -> dict[str, float]:
    """File name of a picture -> PSNR of the view, by the first protocol that has one; weighted, if it has no other."""
    found: dict[str, float] = {}
    for view, numbers in (pair for one in scores.values() for pair in one.views.items()):
        if (psnr := numbers.get("psnr", numbers.get("ws_psnr"))) is not None:
            found.setdefault(picture_name(view), psnr)
    return found


def _config(values: Mapping[str, Any], where: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _config(value, f"{where}{key}.")
        else:
            yield f"{where}{key}", value
