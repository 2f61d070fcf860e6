"""Training runs on the tiny scene, by the configuration of tests/runs/conftest.py."""

import io
from pathlib import Path

from rich.console import Console

from padgs import results
from padgs.runs import run as pipeline
from padgs.runs.store import RunStore

ITERATIONS = 12
SMALL = ("method=padgs", "protocol=paper", "protocol.paper.lpips=none")


def run(config) -> tuple[results.Result, str]:
    out = io.StringIO()
    return pipeline.run(config, Console(file=out, width=200)), out.getvalue()


def folder_of(config) -> RunStore:
    (path,) = Path(config.run.folder).iterdir()
    return RunStore(path)


def stop_at(iteration: int, monkeypatch, how) -> None:
    """Do `how` right after an iteration was shown."""
    update = pipeline.LiveLine.update

    def stopping(self, record, psnr):
        update(self, record, psnr)
        if record.iteration == iteration:
            how()

    monkeypatch.setattr(pipeline.LiveLine, "update", stopping)
