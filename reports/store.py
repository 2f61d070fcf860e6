"""Finished runs, read from a folder of run folders or from a store, which is one file with a line for each run.

A line is the content of the `result.json` with its digest, and under `log` the PSNR of a held-out view during training.
Pictures are not stored.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from filelock import FileLock
from PIL import Image

from padgs import results
from padgs.files import DAMAGE, ImageError, open_image, write_atomically
from padgs.results import Result, ResultError

FILE_NAME = "results.jsonl"
PATIENCE = 120  # seconds for other reports that add runs to the same store
LOGGED = ("iteration", "seconds", "psnr")  # seconds of training so far; dB
LOGGED_BY_SOME = ("polar_transmittance",)  # measured for PaD-GS only


@dataclass(frozen=True)
class Run:
    """A finished run: result, log, and folder of renders."""

    result: Result
    log: Mapping[str, Sequence[float]] = field(default_factory=lambda: dict.fromkeys(LOGGED, ()))  # of `LOGGED`
    document: Mapping[str, Any] | None = None  # content of the result file
    renders: Path | None = None  # folder of ground truth | render | error of each test view; None in a store

    @cached_property
    def row(self) -> tuple[Mapping[str, Any], ...]:
        """Parts of a row of the frame."""
        from padgs.reports.frame import row_of  # imports this module

        return row_of(self)


def read(source: Path) -> tuple[list[Run], list[ResultError]]:
    """Return the runs of a folder or a store in the order of their names, and an error for each unusable one.

    A copy of a run is unusable beside it; the one with the shorter name of its folder counts. A ResultError is raised
    if the store cannot be read at all.
    """
    if source.is_file():
        lines = enumerate(results.file_content(source).splitlines(), start=1)
        loads = {f"{source}:{number}": partial(_from_line, line) for number, line in lines if line.strip()}
    else:
        distinct: dict[Path, Path] = {}  # without links to runs beside them
        found = source.glob(f"*/{results.FILE_NAME}")
        for path in sorted(found, key=lambda file: (file.parent.is_symlink(), len(file.parent.name), file)):
            distinct.setdefault(path.resolve(), path)
        loads = {str(path): partial(_from_folder, path) for path in distinct.values()}
    runs, errors = dict[str, Run](), list[ResultError]()
    for where, load in loads.items():
        try:
            run = load(where)
            if (name := run.result.run) in runs:
                raise ResultError(f"{where} is a copy of run {name}; delete one of them")
            runs[name] = run
        except ResultError as error:
            errors.append(error)
    return [runs[name] for name in sorted(runs)], errors


def _usable(run: Run, where: str) -> Run:
    """Return a run of which a row can be made; other errors are those of a file from elsewhere."""
    try:
        run.row  # noqa: B018 - kept
    except Exception as error:
        why = f"{type(error).__name__}: {str(error):.300}"
        raise ResultError(f"{where} has values that no run has ({why}); delete it and run again") from error
    return run


def add(runs: Iterable[Run], store: Path) -> list[Run]:
    """Add runs to a store, replacing those of the same name but for their experiments; return all runs in it.

    A ResultError says that a line of the store is damaged, and would be lost. The old store stays after an OSError.
    """
    with FileLock(store.with_name(f".{store.name}.lock"), timeout=PATIENCE):
        stored, damaged = read(store) if store.exists() else ([], [])
        if damaged:
            raise damaged[0]
        by_name: dict[str, Run] = {}
        for run in (*stored, *runs):
            if known := by_name.get(run.result.run):  # its tables need the run, too
                experiments = results.joined(known.result.experiments, run.result.experiments)
                if experiments != run.result.experiments:
                    run = replace(run, result=replace(run.result, experiments=experiments), document=None)
            by_name[run.result.run] = run
        merged = [by_name[name] for name in sorted(by_name)]
        lines = ({**(run.document or results.encoded(run.result)), "log": run.log} for run in merged)
        texts = (json.dumps(line, separators=(",", ":"), allow_nan=False) for line in lines)
        write_atomically(store, "".join(f"{text}\n" for text in texts).encode())
    return merged


def render_names(folder: Path | None) -> list[str]:
    """Return the sorted file names of a run's renders of test views; none in a store."""
    return [] if folder is None else sorted(path.name for path in folder.glob("*.png"))


def split_image(path: Path, count: int) -> list[Image.Image]:
    """Return `count` parts of equal width that lie side by side in an image file; an OSError says why it has none."""
    with open_image(path) as image:
        try:
            image.load()
        except DAMAGE as error:
            raise ImageError(f"{path} is damaged ({error}); score the run again") from error
        if not (width := image.width // count):
            raise ImageError(f"{path} has a width of {image.width}, and not {count} images side by side; remove it")
        return [image.crop((part * width, 0, (part + 1) * width, image.height)) for part in range(count)]


def _from_line(line: bytes, where: str) -> Run:
    if run := re.search(rb'"run":\s*"([\w.-]{1,99})', line):  # even of a line that cannot be parsed
        where += f" ({run[1].decode()})"
    document = results.parsed(line, where)
    log = document.pop("log", None)
    if not isinstance(log, dict) or not {*LOGGED} <= log.keys() <= {*LOGGED, *LOGGED_BY_SOME}:
        raise ResultError(f"{where} has no log of {', '.join(LOGGED)}; delete it and collect the run again")
    lengths = {len(values) if isinstance(values, list) else None for values in log.values()}
    if len(lengths) > 1 or not all(_is_measured(name, value) for name in log for value in log[name] or ()):
        raise ResultError(f"{where} has a log that no run writes; delete it and collect the run again")
    return _usable(Run(results.decoded(document, where), log, document), where)


def _from_folder(file: Path, where: str) -> Run:
    document, lines = results.parsed(results.file_content(file), where), results.log_lines(file.parent)
    probes = [line for line in lines if all(_is_measured(name, line.get(name)) for name in LOGGED)]
    rare = [name for name in LOGGED_BY_SOME if probes and all(name in probe for probe in probes)]
    log = {name: [probe[name] for probe in probes] for name in (*LOGGED, *rare)}
    return _usable(Run(results.decoded(document, where), log, document, file.parent / results.PICTURES), where)


def _is_measured(name: str, value: Any) -> bool:
    low = -1e9 if name == "psnr" else 0
    return isinstance(value, (int, float)) and low <= value < 1e18  # refuses NaN, too
