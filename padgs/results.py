"""Result of a run, `result.json`, and the names of the files beside it. Standard library only: reports need no torch.

The file is written last and atomically: if it exists, the run is finished. A failed run has one too, with a status.
"""

import hashlib
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import NoneType
from typing import Any

from padgs.checks import typed
from padgs.files import file_name, read_regular, write_atomically

STATUSES = {
    "ok": "trained to the end and evaluated",
    "oom": "an allocation failed, or memory would have passed the declared limit",
    "nan": "a loss, gradient or parameter was not finite",
    "diverged": "the loss rose far above its best and stayed there, or test views are worse than one mean colour",
    "collapsed": "almost nothing was left to render",
    "exploded": "the number of Gaussians grew far beyond all pixels",
    "degenerate": "images may be fine, but the depth is wrong",
    "timeout": "the time limit came before the last iteration",
    "rejected": "the input was refused with a clear error",
}
STOP_REQUESTED = "asked to stop and score"  # `ended` of a run stopped by the user, which is no repeat of a full run
EXTERNAL = ("program", "version", "label")  # keys of Result.external; program and version may be empty
AD_HOC = "ad_hoc"  # in `experiments`: the run was also requested without an experiment
# By a word in the name of a metric
HIGHER_IS_BETTER = {"psnr": True, "ssim": True, "lpips": False, "rel": False, "delta": True}
SMALLEST_LOSSES = (0.05, 0.1, 0.25, 0.5, 1.0)  # dB; `padgs smallest` finds the smallest model for each
SMALLEST_STATED = 0.1  # dB; the loss of the headline number, and of the model that is kept by default
SMALLEST_PICTURED = (SMALLEST_STATED, 1.0)


@dataclass(frozen=True)
class Scores:
    """Metrics of one run under one protocol; metrics of different protocols cannot be compared."""

    protocol: dict[str, Any]  # all its rules
    metrics: dict[str, float | None]  # metric -> mean over the test views; None = missing
    views: dict[str, dict[str, float | None]]  # view -> metric -> value
    notes: tuple[str, ...] = ()  # missing metrics, with the reason


@dataclass(frozen=True)
class Result:
    """One finished run. Times are in seconds unless the name says ms; memory in bytes."""

    run: str  # run id = name of the run folder
    status: str  # key of STATUSES
    method: str  # name in `baselines.METHODS`
    preset: str  # value of `method=`: a method, or a file in conf/method
    variant: str  # row of an ablation; empty for none
    dataset: str  # synthetic, a name of padgs.data.DATASETS, or empty for own captures
    scene: str
    width: int  # of the test views, pixels
    height: int
    iterations: int  # requested; with a budget of seconds, those that were done
    iterations_done: int
    seed: int
    code_version: str
    machine: dict[str, Any]  # see `padgs.clock.machine`
    config_hash: str
    fingerprint: str  # of the data
    finished: str  # UTC, ISO 8601
    reason: str = ""  # why a run failed
    ended: str = ""  # why the run skipped part of its schedule, see `padgs.training.health`
    scores: dict[str, Scores] = field(default_factory=dict)  # protocol -> scores
    timing: dict[str, float] = field(default_factory=dict)  # train_seconds, cpu_seconds, render_ms_{min,median}
    counts: dict[str, int] = field(default_factory=dict)  # anchors, gaussians, ...
    model_bytes: int = 0
    peak_memory_bytes: int = 0  # of all processes that trained
    peak_device_memory_bytes: int | None = None  # of torch's tensors on the GPU, while training; None on the CPU
    config: dict[str, Any] = field(default_factory=dict)  # the resolved configuration
    experiments: tuple[str, ...] = ()  # experiments and sweeps of the run, sorted; see `joined`
    smallest: dict[str, Any] = field(default_factory=dict)  # see `padgs.runs.smallest.Search.front`
    # EXTERNAL -> text, if another program made the model or its renders (`padgs score`); the method is "external" then
    external: dict[str, str] = field(default_factory=dict)
    # test view -> camera model (panorama, pinhole, opencv_fisheye, ...) if not all views are panoramas; else empty
    cameras: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.status not in STATUSES:
            raise ValueError(f"unknown status {self.status!r}; known: {', '.join(STATUSES)}")

    @property
    def ok(self) -> bool:
        """True if the scores count."""
        return self.status == "ok"


def joined(first: Iterable[str], second: Iterable[str]) -> tuple[str, ...]:
    """Return the experiments of a run requested by two commands; empty if neither names an experiment.

    >>> joined(("tau",), ("table1",)), joined((), ("tau",)), joined((), ())
    (('table1', 'tau'), ('ad_hoc', 'tau'), ())
    """
    names = {*(tuple(first) or (AD_HOC,)), *(tuple(second) or (AD_HOC,))}
    return () if names == {AD_HOC} else tuple(sorted(names))


def higher_is_better(metric: str) -> bool | None:
    """Return whether higher values of a metric are better; None if neither end is.

    >>> higher_is_better("ws_psnr_pole"), higher_is_better("lpips_vgg_01"), higher_is_better("seam")  # best at 1
    (True, False, None)
    """
    return next((HIGHER_IS_BETTER[word] for word in metric.split("_") if word in HIGHER_IS_BETTER), None)


# Configuration keys that results do not depend on except by rounding: those of the machine, and others. The fingerprint
# stands for the data, scoring comes after training, and the monitor may end a run but changes no number.
OF_THE_MACHINE = ("run", "render.max_instances", "data.cache_bytes", "data.disk_cache", "data.prefetch_threads")
DECIDE_NOTHING = (*OF_THE_MACHINE, "data.path", "init.run", "protocol", "train.monitor")


def decisive(config: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Return a configuration without the keys of DECIDE_NOTHING."""
    return {
        key: decisive(value, f"{where}{key}.") if isinstance(value, Mapping) else value
        for key, value in config.items()
        if f"{where}{key}" not in DECIDE_NOTHING
    }


LOG_NAME, CONFIG_NAME = "log.jsonl", "config.yaml"
PICTURES = "renders"  # folder of images: ground truth | render | error of each test view


def flat(values: Mapping[str, Any], where: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted key and value of nested mappings.

    >>> dict(flat({"seed": 1, "data": {"width": 64}}))
    {'seed': 1, 'data.width': 64}
    """
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{where}{key}.")
        else:
            yield f"{where}{key}", value


def log_lines(run_folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the complete lines of a run's log, each with its `iteration`; a missing log has no lines."""
    try:
        lines = read_regular(run_folder / LOG_NAME).splitlines()
    except OSError:
        return
    for line in lines:
        try:
            entry = json.loads(line)
            entry["iteration"] = int(entry["iteration"])
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            continue
        yield entry


def picture_name(view: str) -> str:
    """Return the file name of the image of a test view, in `renders` of a run.

    >>> picture_name("left/R001 a")
    'left-R001-a.png'
    """
    return file_name(view) + ".png"


SCHEMA = 2
LONGEST_NAME = 255  # letters, as of a file
FILE_NAME = "result.json"
CONFIG_GROUPS = {"budget", "data", "method", "protocol", "render", "run", "stress", "train"}  # sections of settings
# Names that are safe in a path and a command line; `@` separates an experiment from its scale.
PLAIN = re.compile(r"[^\W_][\w.-]*(@[\w.-]+)?")


class ResultError(ValueError):
    """A result file cannot be used; the message names the file, the error and the way out."""


def write(result: Result, folder: Path) -> Path:
    """Write `result.json` atomically into the run folder; return its path. An older file stays after an OSError."""
    path = folder / FILE_NAME
    write_atomically(path, (json.dumps(encoded(result), indent=1, allow_nan=False) + "\n").encode())
    return path


def read(path: Path) -> Result:
    """Read one `result.json`; a ResultError says that it is missing, truncated, of another version, or was edited."""
    return decoded(parsed(file_content(path), str(path)), str(path))


def file_content(path: Path) -> bytes:
    """Return the bytes of a file, or raise a ResultError."""
    try:
        return read_regular(path)
    except OSError as error:
        raise ResultError(f"cannot read {path}: {error.strerror}") from error


def encoded(result: Result) -> dict[str, Any]:
    """Return a result as the document of its file: schema version, digest, and all fields."""
    content = _encode(asdict(result))
    for name in ("external", "cameras"):  # only where they say something
        if not content[name]:
            del content[name]
    return {"schema": SCHEMA, "sha256": _digest(content), **content}


def parsed(content: bytes, where: str) -> dict[str, Any]:
    """Parse the JSON of a document; raise a ResultError, which says `where`, if it is no result."""
    try:
        document = json.loads(content, parse_constant=_int, parse_int=_int)
        json.dumps(document, ensure_ascii=False, allow_nan=False).encode()  # not possible for lone surrogates
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ResultError(f"{where} is not JSON ({error}); delete it and run again") from error
    except ValueError as error:
        raise ResultError(f"{where}: {error}; delete it and run again") from error
    if not isinstance(document, dict) or "schema" not in document:
        raise ResultError(f"{where} is not a result file (no schema); delete it and run again")
    return document


def _int(text: str) -> int:
    if not text.lstrip("-").isdigit() or not -(2**63) <= (value := int(text)) < 2**63:
        raise ValueError(f"{text:.20} is no number of a result")
    return value


def decoded(document: Mapping[str, Any], where: str) -> Result:
    """Return the result of a document that `encoded` made; `where` names it in errors.

    A ResultError says that it is of another version, was edited, has values of other types, or has names that are
    unsafe in a path or command (a digest is no signature, and files may come from elsewhere).
    """
    document = dict(document)
    if (schema := document.pop("schema")) != SCHEMA:
        is_newer = isinstance(schema, int) and schema > SCHEMA
        advice = "read it with a newer padgs" if is_newer else "delete it and run again"
        raise ResultError(f"{where} was written by another version (schema is not {SCHEMA}); {advice}")
    digest = document.pop("sha256", None)
    try:
        edited = digest != _digest(document)
        scores = _scores(document.pop("scores"))
        result = replace(typed(Result, document), scores=scores)
        _refuse_impossible(result)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        lacks = "lacks " * isinstance(error, KeyError)
        raise ResultError(f"{where}: {lacks}{str(error):.300}; delete it and run again") from error
    if edited:
        raise ResultError(f"{where} was edited after it was written (SHA-256 differs); delete it and run again")
    names = [result.run, result.method, result.preset, *result.experiments, *result.scores]
    for name in (*names, *filter(None, [result.dataset])):
        if not PLAIN.fullmatch(name):
            raise ResultError(f"{where}: {name[:80]!r} is no name that this program gives; leave the file out")
    return result


def _refuse_impossible(result: Result) -> None:
    """Refuse values of the right type that no run writes; a digest is no signature."""
    if result.external.keys() - EXTERNAL or not all(isinstance(text, str) for text in result.external.values()):
        raise TypeError(f"external is {result.external!r}; it must be texts named {', '.join(EXTERNAL)}")
    views = (view for scores in result.scores.values() for view in scores.views)
    cameras = (*result.cameras, *result.cameras.values())
    for name in (*vars(result).values(), *result.external.values(), *cameras, *views):
        if isinstance(name, str) and name != result.reason and len(name) > LONGEST_NAME:
            raise ValueError(f"{name[:20]}... has {len(name)} letters; names have at most {LONGEST_NAME}")
    for name in CONFIG_GROUPS & result.config.keys():
        if not isinstance(result.config[name], dict):
            raise TypeError(f"config.{name} is {result.config[name]!r}; it must be a group of settings")
    stress, budget = result.config.get("stress", {}), result.config.get("budget", {})
    if not isinstance(stress.get("condition"), (str, NoneType)) or not isinstance(stress.get("level"), (int, NoneType)):
        raise TypeError(f"config.stress is {stress!r}; it must have a name and a level")
    if float(budget.get("seconds") or 0) < 0:
        raise ValueError(f"config.budget.seconds is {budget['seconds']}; it must be at least 0")
    if not PLAIN.fullmatch(str(clock := budget.get("clock", "wall"))):  # findings print it in a command
        raise ValueError(f"config.budget.clock is {clock!r}; it must be a name")
    rules = [*result.config.get("protocol", {}).values(), *(scores.protocol for scores in result.scores.values())]
    if odd := [rule for rule in rules if not isinstance(rule, dict)]:
        raise TypeError(f"the rules of a protocol are {odd[0]!r}; they must be a table")


def _digest(content: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, allow_nan=False).encode()).hexdigest()


def _encode(value: Any) -> Any:
    """Return a value for JSON; infinities, such as the PSNR of a perfect image, become strings."""
    if isinstance(value, dict):
        return {str(key): _encode(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_encode(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _numbers(table: dict[str, Any]) -> dict[str, Any]:
    return {name: None if value is None else float(value) for name, value in table.items()}


def _scores(table: dict[str, Any]) -> dict[str, Scores]:
    try:
        found = {}
        for name, one in table.items():
            views = {view: _numbers(values) for view, values in one["views"].items()}
            found[name] = Scores(one["protocol"], _numbers(one["metrics"]), views, tuple(one["notes"]))
        return found
    except (KeyError, TypeError, AttributeError) as error:
        raise TypeError(f"scores do not have the form that this program writes ({str(table):.60})") from error
