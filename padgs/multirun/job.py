"""One job of Hydra: a run of its own, or one of a multirun, in this process or in another one."""

from __future__ import annotations

import os
import traceback
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from hydra.conf import HydraConf
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from padgs.multirun.board import CRASHED, ELSEWHERE, REFUSED, RUNNING, STOPPED, Board, JobState
from padgs.runs import session
from padgs.runs.checkpoint import CheckpointError
from padgs.runs.config import config_from_values
from padgs.runs.folder import RunFolderError
from padgs.runs.interrupt import Interrupted
from padgs.runs.labels import Labels, labels
from padgs.runs.lock import RunBusy
from padgs.tracking.tracking import TrackedRun, Tracker
from padgs.tracking.watch import Watch

EXPECTED = (ValueError, OSError, CheckpointError, RunFolderError, RunBusy)  # a traceback would only hide what they say
ENDS: list[str] = []  # how the job ended that was this process's only one; Hydra's main returns nothing


def job(composed: DictConfig) -> str:
    """Run what Hydra composed; part of a multirun raises nothing but an interruption, so that the others go on.

    Returns:
        How it ended: a status of `padgs.results`, or one of `padgs.multirun.board`.
    """
    hydra = HydraConfig.get()
    values: Any = OmegaConf.to_container(composed, resolve=True)
    names = labels(hydra.runtime.choices)
    if hydra.mode != RunMode.MULTIRUN:
        ENDS.append(_only_job(values, names))
        return ENDS[-1]
    board = Board(Path(hydra.sweep.dir))
    with ExitStack() as stack:
        alone = in_own_process(hydra)
        console = Console(file=stack.enter_context(board.output(hydra.job.num)), width=120) if alone else Console()
        entry = BoardEntry(board, hydra.job.num)
        try:
            if entry.stop_requested():
                raise Interrupted("not started")
            config = config_from_values(values, names)
            entry.data = None if config.data.path is None else str(Path(config.data.path).absolute())
            result = session.run(config, console, entry)
            return entry.end(result.status, result.reason)
        except KeyboardInterrupt as error:
            entry.end(STOPPED, str(error))
            if alone:
                return STOPPED
            raise
        except EXPECTED as error:
            return entry.end(ELSEWHERE if isinstance(error, RunBusy) else REFUSED, str(error))
        except Exception as error:
            console.print(traceback.format_exc(), markup=False, highlight=False, soft_wrap=True)
            return entry.end(CRASHED, f"{type(error).__name__}: {error}")


def complain(message: str) -> None:
    """Say what is wrong, on the error stream."""
    Console(stderr=True).print(f"error: {message}", style="red", markup=False, highlight=False, soft_wrap=True)


def _only_job(values: dict[str, Any], names: Labels) -> str:
    try:
        config, console = config_from_values(values, names), Console()
        say = partial(console.print, style="dim", markup=False, highlight=False, soft_wrap=True)
        watch = TrackedRun(Tracker(config.tracking, Path(config.run.folder), " ".join(names.experiments), say))
        result = session.run(config, console, watch)
        watch.finished()
        return result.status
    except EXPECTED as error:
        if os.environ.get("HYDRA_FULL_ERROR"):
            raise
        complain(str(error))
        return REFUSED


def in_own_process(hydra: DictConfig | HydraConf) -> bool:
    """Whether jobs run in other processes than the one that launches them."""
    return not str(hydra.launcher._target_).endswith("BasicLauncher")


class BoardEntry(Watch):
    """Writes what a job does on the board of its multirun."""

    def __init__(self, board: Board, number: int) -> None:
        """Of the job with this number."""
        self.data: str | None = None  # folder of the data set
        self._board, self._number, self._state = board, number, JobState(RUNNING)
        self._board.write(number, self._state)

    def started(self, folder: Path, iterations: int) -> None:
        """The run is known."""
        self._state = replace(self._state, run=folder.name, iterations=iterations, data=self.data)
        self._board.write(self._number, self._state)

    def stop_requested(self) -> bool:
        """Whether the multirun is to stop."""
        return self._board.stop_requested()

    def end(self, status: str, reason: str = "") -> str:
        """The job has ended; returns the status."""
        self._state = replace(self._state, status=status, reason=reason)
        self._board.write(self._number, self._state)
        return status
