"""A finished run, small enough to be made in a second or two: 3 training and 2 test views of 32x16 of the room."""

import shutil
import subprocess
from pathlib import Path

import pytest
from rich.console import Console

from padgs.multirun.composition import composing, configuration
from padgs.runs.run import run

SETTINGS = [
    "train.iterations=30",
    "data.generator.width=32",
    "data.generator.train_views=3",
    "data.generator.test_views=2",
    "data.generator.samples=1",
    "data.generator.points=200",
    "protocol=sphere",
    "protocol.sphere.lpips=none",
    "run.device=cpu",
    "tracking=none",
]


_made: dict[tuple[str, ...], Path] = {}


def tiny_run(factory: pytest.TempPathFactory, *settings: str) -> Path:
    """A folder of its own of a run of `method=omnigs`, or of what the settings say, which a process trains once."""
    if settings not in _made:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("PADGS_CACHE", str(factory.getbasetemp() / "scenes"))
            runs = factory.mktemp("runs")
            with composing():
                config = configuration(["method=omnigs", *SETTINGS, *settings, f"run.folder={runs}"])
            run(config, Console(quiet=True))
        _made[settings] = next(path.parent for path in runs.glob("*/result.json"))
    return Path(shutil.copytree(_made[settings], factory.mktemp("runs") / _made[settings].name))


SMALLEST = [  # for `padgs-run` as a process
    "protocol=paper",
    "protocol.paper.lpips=none",
    "data.generator.width=64",
    "data.generator.train_views=4",
    "data.generator.test_views=1",
    "data.generator.samples=1",
    "data.generator.points=400",
    "run.threads=1",
]


def finish(process: subprocess.Popen) -> tuple[int, str, str]:
    """Wait for a process; return its exit code, output and errors."""
    out, error = process.communicate(timeout=400)
    return process.returncode, out, error
