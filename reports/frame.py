"""All runs in one data frame, a row a run, from which every table, chart and CSV file is made.

Columns: identity of a run (`place`, `preset`, `variant`, `seed`, ...) and its status (`ok`, `status`); conditions
(`resolution`, `data`, `machine`, `paper rules`, ...); numbers (`paper/psnr`, `frame_ms`, ...), NaN where missing; and
each key of its configuration (`config.train.iterations`), None where missing.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any

import pandas as pd
from pandas import DataFrame

from padgs.checks import printable
from padgs.reports.methods import EXTERNAL, METHODS, outside
from padgs.reports.published import SAME_DATA, Place
from padgs.reports.store import Run
from padgs.results import (
    AD_HOC,
    DECIDE_NOTHING,
    SMALLEST_LOSSES,
    SMALLEST_STATED,
    STOP_REQUESTED,
    Result,
    Scores,
    flat,
    picture_name,
)

CONFIG = "config."  # prefix of a dotted key
WITHOUT_EFFECT = ("seed", *DECIDE_NOTHING)  # keys that make no other setting; a section stands for all its keys
# Options that older results do not name, and what those runs did. An option that is None is as one that is missing.
BEFORE = {"method.length_unit": "extent", "method.means_least_pace": 1.0, "train.random_background": False}
BEFORE |= {"render.steepness": 0.0}
OF_A_SCENE = ("data.", "method.sha256", "method.transform", "method.voxel_size")  # beginnings of its keys
ELSEWHERE = "made elsewhere"  # length of training of external models
INPUT_RANGES = {"01": "[0, 1]", "11": "[-1, 1]"}
PUBLISHED_ITERATIONS, LARGEST_FACTOR = 30_000, 8.0
LINEAR = ("omnigs", "odgs", "op43dgs", "sc_omnigs")  # methods with a law of their own for learning rates
LINEAR_ITERATIONS = 3000


def frame(runs: Iterable[Run]) -> DataFrame:
    """Return the frame of runs in their order; the index counts them."""
    runs = list(runs)
    parts = [[run.row[part] for run in runs] for part in range(5)]
    facts, rules = (_columns(rows, object, names) for rows, names in zip(parts[:2], (FACTS, ()), strict=True))
    facts["log"], facts["renders"] = [run.log for run in runs], [run.renders for run in runs]
    metrics, numbers = _columns(parts[2], float), _columns(parts[3], float, NUMBERS)
    numbers["polar_transmittance"] = [[math.nan, *run.log.get("polar_transmittance", ())][-1] for run in runs]
    numbers["train_hours"], numbers["fps"] = numbers["train_seconds"] / 3600, 1000 / numbers["frame_ms"]
    config = _columns(parts[4], object).add_prefix(CONFIG)
    made = pd.concat([facts.astype({"ok": bool}), rules, metrics, numbers, config], axis=1)
    return made.copy()  # a block of memory for each type, which makes every selection of rows faster


def row_of(run: Run) -> tuple[dict[str, Any], ...]:
    """Return the facts, rules, metrics, numbers and configuration of a run; any exception if it has other values."""
    result = _one_line(run.result)
    numbers = {name: None if (value := of(result)) is None else float(value) for name, of in NUMBERS.items()}
    facts = {name: of(result) for name, of in FACTS.items()}
    metrics = {f"{name}/{metric}": value for name, of in result.scores.items() for metric, value in of.metrics.items()}
    return facts, dict(_rules(result)), metrics, numbers, values_of(result)


def _one_line(value: Any) -> Any:
    """Return a result or a part of it; its texts become lines without control characters, as every report shows them.

    Names of views stay as they are, since files are called after them.
    """
    if isinstance(value, (Result, Scores)):
        return replace(value, **{name: _one_line(own) for name, own in vars(value).items() if name != "views"})
    if isinstance(value, Mapping):
        return {_one_line(key): _one_line(own) for key, own in value.items()}
    if isinstance(value, list):
        return [_one_line(own) for own in value]
    return printable(value, kept="") if isinstance(value, str) else value


def grouped(runs: DataFrame, *columns: str) -> list[tuple[tuple[Any, ...], DataFrame]]:
    """Return (values, runs) for each combination of values in some columns, in order of appearance.

    Runs with a missing value are left out. Three times as fast as `DataFrame.groupby` on the small frames of a table.
    """
    rows: dict[tuple[Any, ...], list[int]] = {}
    for number, *values in zip(range(len(runs)), *(runs[column] for column in columns), strict=True):
        rows.setdefault(tuple(values), []).append(number)
    known = (values for values in rows if all(value is not None and value == value for value in values))  # nor NaN
    return [(values, runs.take(rows[values])) for values in known]


def by_place(runs: DataFrame) -> dict[Place, DataFrame]:
    """Return the runs of each scene, in the order of the tables."""
    found = {place: own for (place,), own in grouped(runs, "place")}
    return {place: found[place] for place in sorted(found, key=lambda place: place.rank)}


def by_conditions(runs: DataFrame, *columns: str) -> dict[str, DataFrame]:
    """Return title -> runs of one scene that agree in some columns, in the order of the tables."""
    found = {}
    for place, own in by_place(runs).items():
        own = own.fillna({"length": ELSEWHERE})
        for values, alike in grouped(own.sort_values(["resolution", "iterations"], kind="stable"), *columns):
            found[", ".join([place.title, *values])] = alike
    return found


def law(iterations: int, method: str = "") -> float:
    """Return the factor of `train.learning_rates=run`, as `Pace` of training, which needs torch; tests compare both."""
    linear = method in LINEAR or (method not in METHODS and outside(method, "RUN_RATES") == "run_linear")
    factor = LINEAR_ITERATIONS / iterations if linear else math.sqrt(PUBLISHED_ITERATIONS / iterations)
    return min(max(factor, 1.0), LARGEST_FACTOR)


def images_seen(result: Result) -> float | None:
    """Return the number of training pixels seen, repetitions included, in whole panoramas; None where unknown.

    An iteration sees a panorama, as many pixels of its views, or rays; results do not tell how long views were smaller.
    """
    options, share = result.config.get("method", {}), 1.0
    if result.method == "egonerf":
        share = options["rays"] / (result.width * result.height) if "rays" in options else None
    elif result.external or (options.get("coarse_share") and result.width >= 1024):
        share = None
    return None if share is None else share * result.iterations_done


def decides(key: str) -> bool:
    """Return whether runs that differ in a dotted key have different settings.

    >>> decides("train.iterations"), decides("run.threads")
    (True, False)
    """
    return not any(key == other or key.startswith(f"{other}.") for other in WITHOUT_EFFECT)


def values_of(result: Result) -> dict[str, Any]:
    """Return dotted key -> value of the configuration, also of options that are newer than the run.

    Without those of the generator for data from files, which ignore them.
    """
    found = dict(flat(result.config))
    if found.get("data.path") and found.get("data.format") != "synthetic":
        found = {key: value for key, value in found.items() if not key.startswith("data.generator.")}
    return found | BEFORE | found


def setting(config: Mapping[str, Any]) -> str:
    """Return what of dotted keys and values decides the setting of a run."""
    return json.dumps({k: value for k, value in config.items() if value is not None and decides(k)}, sort_keys=True)


def without_data(runs: DataFrame) -> DataFrame:
    """Return runs whose settings are compared without those of their scene, for means over scenes."""
    kept = [json.loads(text).items() for text in runs["setting"]]
    of_methods = [setting({key: value for key, value in own if not key.startswith(OF_A_SCENE)}) for own in kept]
    columns = [column for column in runs if column.removeprefix(CONFIG).startswith(OF_A_SCENE)]
    return runs.drop(columns=columns).assign(setting=of_methods)


def _hardware(result: Result) -> str:
    known, count = result.machine, result.machine.get("cores")
    where = known.get("gpu") or f"{count} core{'s' * (count != 1)} of {known.get('cpu')}"
    return f"{where}, torch {known.get('torch')}"


SEARCHED_ON = "machine of the search"  # for the smallest model; its times are of that


def _machine(result: Result) -> str:
    """Return the hardware with the number of threads, on which times depend."""
    threads = result.machine.get("threads")
    return _hardware(result) + (f", {threads} threads" if threads else "")


def _columns(rows: Sequence[Mapping[str, Any]], dtype: type, names: Iterable[str] = ()) -> DataFrame:
    """Return a column for each name, given or in any row; missing values are None, or NaN among numbers."""
    names = dict.fromkeys([*names, *(name for row in rows for name in row)])
    return DataFrame({name: [row.get(name) for row in rows] for name in names}, index=range(len(rows)), dtype=dtype)


def _rules(result: Result) -> Iterator[tuple[str, str]]:
    """Yield the rules of each protocol: those applied, or those configured."""
    scored = {name: scores.protocol for name, scores in result.scores.items()}
    for name, rules in {**result.config.get("protocol", {}), **scored}.items():
        words = [name, f"LPIPS-{rules.get('lpips')} fed {INPUT_RANGES.get(rules.get('lpips_inputs', ''))}"]
        if rules.get("bottom_crop"):
            words.append(f"without the last {100 * rules['bottom_crop']:.1f} % of the rows")
        yield f"{name} rules", ", ".join(words)


def _length(result: Result) -> str:
    """Return the length of training and the limits of the model in words."""
    budget = result.config.get("budget", {})
    words = [f"{result.iterations} iterations"]
    if "seconds" in budget:
        words = [f"{budget['seconds']:g} s{' of CPU time' if budget['clock'] == 'cpu' else ''}"]
    if count := budget.get("gaussians"):
        words.append("Gaussians as needed" if count == "auto" else f"at most {count:,} Gaussians".replace(",", " "))
    return ", ".join([*words, *(["until nothing is gained"] if budget.get("stop") == "auto" else [])])


def _learning_rates(result: Result) -> Any:
    """Return `train.learning_rates` where it has an effect; None for methods without the choice."""
    choice = result.config.get("train", {}).get("learning_rates", "published")
    is_trained = result.iterations and not result.external  # a run of seconds may fail before its first iteration
    if result.method == "egonerf" or not is_trained:
        return None
    timed = "seconds" in result.config.get("budget", {})  # seeds differ in iterations, and not in the choice
    return "published" if choice == 1 or (choice == "run" and not timed and law(result.iterations) == 1) else choice


def _factor(result: Result) -> float | None:
    choice = result.config.get("train", {}).get("learning_rates", "published")
    if result.external or not result.iterations:
        return None
    if choice in ("run", "run_linear"):
        return law(result.iterations, "omnigs" if choice == "run_linear" else result.method)
    return 1.0 if choice == "published" else float(choice)


def _searched(found: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what a search for the smallest model found, if it has the numbers that tables and charts show."""
    for step in found.get("steps", ()):
        numbers = [step[name] for name in ("rows", "blended", "bytes", "frame_ms", "loss", "ws_psnr")]
        if not all(0 < float(number) < math.inf for number in numbers[:3]):
            raise ValueError(f"a step of `smallest` has {numbers[:3]} rows, Gaussians and bytes")
        [float(number) for number in (*numbers, step["lpips"] or 0)]
    if "steps" in found:
        [found["steps"][found[of][f"{loss:g}"]] for loss in SMALLEST_LOSSES for of in ("minimal", "possible")]
        [float(found[name] or 0) for name in ("rows", "cpu_seconds", "ws_psnr")]
    return found


def _view_psnr(scores: Mapping[str, Scores]) -> dict[str, float]:
    """Return file name of a render -> PSNR (or else WS-PSNR) of the view, by the first protocol that has it."""
    found: dict[str, float] = {}
    for view, numbers in (pair for one in scores.values() for pair in one.views.items()):
        if (psnr := numbers.get("psnr", numbers.get("ws_psnr"))) is not None:
            found.setdefault(picture_name(view), psnr)
    return found


def _training_seconds(result: Result) -> float | None:
    """Return the training time of the device that trained: CPU time of the process, or wall time on a GPU."""
    wall = result.timing.get("train_seconds")
    return wall if result.machine.get("gpu") else result.timing.get("cpu_seconds", wall)


SAME = ("run", "ok", "status", "method", "variant", "dataset", "scene", "seed", "iterations")
SAME += ("code_version", "finished")
FACTS: Mapping[str, Callable[[Result], Any]] = {
    **{name: attrgetter(name) for name in SAME},
    "preset": lambda result: f"{EXTERNAL}{result.external['label']}" if result.external else result.preset,
    "external": lambda result: " ".join(filter(None, map(result.external.get, ("program", "version")))) or None,
    "experiments": lambda result: result.experiments or (AD_HOC,),
    "place": lambda result: Place.of(result.dataset, result.scene, result.fingerprint),
    "resolution": lambda result: f"{result.width}x{result.height}",
    "data": lambda result: SAME_DATA.get(result.fingerprint[:10], result.fingerprint[:10]),
    # test views of each kind, "2 panorama, 1 pinhole"; None: all are panoramas
    "cameras": lambda result: ", ".join(f"{n} {kind}" for kind, n in Counter(result.cameras.values()).items()) or None,
    "length": lambda result: None if result.external else _length(result),
    "learning_rates": _learning_rates,
    "hardware": _hardware,
    "machine": _machine,
    SEARCHED_ON: lambda result: _machine(replace(result, machine=result.smallest.get("machine", result.machine))),
    "setting": lambda result: setting(values_of(result)),
    "smallest": lambda result: _searched(result.smallest),
    "stopped": lambda result: result.ended == STOP_REQUESTED,  # by hand
    "view_psnr": lambda result: _view_psnr(result.scores),
}
NUMBERS: Mapping[str, Callable[[Result], float | None]] = {
    "iterations_done": lambda result: None if result.external else result.iterations_done,
    "images": images_seen,
    "rate_factor": _factor,
    "train_seconds": _training_seconds,
    "wall_seconds": lambda result: result.timing.get("train_seconds"),
    "cpu_seconds": lambda result: result.timing.get("cpu_seconds"),  # of the processes that trained
    "frame_ms": lambda result: result.timing.get("render_ms_median"),  # of repeats, decoding included
    "anchors": lambda result: result.counts.get("anchors"),
    "start": lambda result: result.counts.get("start"),  # Gaussians or anchors before training
    "gaussians": lambda result: result.counts.get("gaussians"),
    "minimal_count": lambda result: (  # Gaussians of the smallest model for a loss of `SMALLEST_STATED` dB
        found["steps"][found["minimal"][f"{SMALLEST_STATED:g}"]]["blended"]
        if "steps" in (found := result.smallest)
        else None
    ),
    "megabytes": lambda result: result.model_bytes / 1e6 or None,
    "peak_gigabytes": lambda result: result.peak_memory_bytes / 1e9 or None,  # of the processes that trained
    "peak_gpu_gigabytes": lambda result: (result.peak_device_memory_bytes or math.nan) / 1e9,  # of the tensors there
}
