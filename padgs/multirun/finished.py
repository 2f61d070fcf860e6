"""Which jobs are known to be finished, so that skipping hundreds of them takes no composing and no loading of scenes.

`<run.folder>/.multirun/finished.jsonl` has a line for each job that ended with a result. A job is recognised by its
command-line settings, the configuration files and the sources, of the program and of packages that bring methods; its
run by the time of its `result.json`, and its data by names, sizes and times of all files. Where anything differs, the
job is composed and looked at as usual.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from padgs import baselines, results
from padgs.multirun.overrides import root

FOLDER = ".multirun"  # in run.folder
FILE_NAME = "finished.jsonl"
# Settings that a job is not recognised by. The rules of scoring decide nothing about training, but whether it is done;
# and where the data lie says whose files are looked at.
NOT_PART = (*results.OF_THE_MACHINE, "launcher", "tracking", "retry", "hydra")
# What lies where `data.path` does not say: another run, which may have another model by now, and files beside the data.
OTHER_FILES = re.compile(r"\+*(init[.=]|data\.(images|mask|points)=)")


class FinishedJobs:
    """The list of one run folder."""

    def __init__(self, runs: Path) -> None:
        self._runs, self._path = runs, runs / FOLDER / FILE_NAME
        self._known: dict[str, dict[str, Any]] = {}
        with suppress(OSError):
            for line in self._path.read_text().splitlines():
                with suppress(ValueError, KeyError, TypeError):  # a damaged line only costs time
                    entry = json.loads(line)
                    self._known[entry["job"]] = entry

    def status(self, overrides: Sequence[str]) -> str | None:
        """The status of a job's result; None where it must be looked at."""
        entry = self._entry(overrides)
        return None if entry is None else entry["status"]

    def run(self, overrides: Sequence[str]) -> Path | None:
        """The folder of a job's run; None where it must be looked at."""
        entry = self._entry(overrides)
        return None if entry is None else self._runs / entry["run"]

    def add(self, overrides: Sequence[str], run: str, status: str, data: str | None) -> None:
        """Remember a job that has ended with a result; a disk that is full loses only this."""
        entry = {"job": key(overrides), "run": run, "status": status, "written": _written(self._runs / run)}
        entry |= {"data": data, "signature": None if data is None else signature(data)}
        self._known[entry["job"]] = entry
        with suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a") as file:
                file.write(json.dumps(entry) + "\n")

    def _entry(self, overrides: Sequence[str]) -> dict[str, Any] | None:
        if any(OTHER_FILES.match(text) for text in overrides):
            return None
        entry = self._known.get(key(overrides))
        if entry is None or (written := _written(self._runs / entry["run"])) is None or entry["written"] != written:
            return None
        return entry if entry["data"] is None or entry["signature"] == signature(entry["data"]) else None


def only_run(arguments: Sequence[str]) -> Path | None:
    """The folder of the run that a command line asks for, if it is one that is known to have ended well."""
    if any(text.startswith(("-", "tracking", "need")) and text != "tracking=none" for text in arguments):
        return None  # options change what is asked for; a tracker may want to hear of an old run; needs are told again
    known = FinishedJobs(folder_of(arguments))
    return known.run(arguments) if known.status(arguments) == "ok" else None


def folder_of(arguments: Sequence[str]) -> Path:
    """Where a command line has its runs: what it says of `run.folder`, or that key's default."""
    given = [text.partition("=")[2] for text in arguments if re.match(r"\+*run\.folder=", text)]
    return Path(os.path.expanduser(given[-1]) if given else "runs")


def key(overrides: Sequence[str]) -> str:
    """What a job is recognised by."""
    kept = sorted(text for text in overrides if not re.match(rf"[+~]*({'|'.join(map(re.escape, NOT_PART))})[.=]", text))
    return hashlib.sha256(json.dumps([*kept, os.getcwd(), _sources()]).encode()).hexdigest()


@cache
def signature(data: str) -> str:
    """Names, sizes and times of all files below a folder, or below that of a file; links are followed."""
    digest = hashlib.sha256()
    top = Path(data).parent if Path(data).is_file() else data
    files, seen = list[Path](), set[str]()
    for folder, inner, names in os.walk(top, followlinks=True):
        files += [Path(folder, name) for name in names]
        if (place := os.path.realpath(folder)) in seen:
            inner.clear()  # a link that leads back up
        seen.add(place)
    for path in sorted(files):
        with suppress(OSError):  # it may be gone by now
            digest.update(f"{path}|{path.stat().st_size}|{path.stat().st_mtime_ns}\n".encode())
    return digest.hexdigest()


@cache
def _sources() -> str:
    digest = hashlib.sha256()
    package = Path(__file__).resolve().parent.parent
    methods = Path(baselines.__file__).parent
    for place in (package, methods, root() / "conf", root() / "sweeps", *_outside_sources()):
        for path in sorted(place.rglob("*")) if place.is_dir() else [place]:
            if path.suffix in (".py", ".yaml"):
                digest.update(path.read_bytes())
    return digest.hexdigest()


def _outside_sources() -> Iterator[Path]:
    """The packages that bring methods, folders and single modules, none of which is imported here."""
    for name in sorted({re.split("[.:]", value)[0] for value in baselines.outside().values()}):
        if spec := find_spec(name):  # else it is left out, as `padgs.multirun.choices` says
            yield from map(Path, spec.submodule_search_locations or filter(None, [spec.origin]))


def _written(run: Path) -> int | None:
    try:
        return (run / results.FILE_NAME).stat().st_mtime_ns
    except OSError:
        return None
