"""The jobs of one multirun as files in a shared folder: what each of them does, wherever it runs.

`<run.folder>/.multirun/<start>/` holds one small file per job, which only that job writes, and `stop`, which asks all
of them to stop. Nothing else couples a job to its parent, so it may run on any machine that sees the folder.
"""

from __future__ import annotations

import json
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TextIO

from padgs.files import write_atomically
from padgs.results import STATUSES
from padgs.runs.run import Callback

WAITING, RUNNING, OK = "waiting", "running", "ok"
# Ends of a job beside the statuses of results, without any:
REFUSED = "refused"  # the configuration or the data cannot be used; there is no run
CRASHED = "crashed"  # an error of ours; the traceback is in the job's output
KILLED = "killed"  # its process died
ELSEWHERE = "elsewhere"  # another process works on this run
STOPPED = "stopped"  # it was asked to, and wrote its checkpoint
SECONDS_BETWEEN_LOOKS = 1.0  # for `stop`


@dataclass(frozen=True)
class JobState:
    """What is known of a job."""

    status: str = WAITING
    run: str = ""  # its run folder, once it is known
    reason: str = ""  # why it failed
    data: str | None = None  # folder of the data set, absolute; None for a generated scene

    @property
    def ended(self) -> bool:
        """Whether nothing more is to be expected."""
        return self.status not in (WAITING, RUNNING)

    @property
    def finished(self) -> bool:
        """Whether there is a result, good or bad."""
        return self.status in STATUSES


class Board:
    """The folder of one multirun."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._looked, self._stop = -float("inf"), False

    def write(self, job: int, state: JobState) -> None:
        """Say what a job does; a full disk must not end it, so nothing is raised."""
        with suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path(job), json.dumps(asdict(state)).encode())

    def read(self, job: int) -> JobState:
        """What a job does; waiting, if it has not said anything."""
        try:
            return JobState(**json.loads(self._path(job).read_bytes()))
        except (OSError, ValueError, TypeError):
            return JobState()

    def output(self, job: int) -> TextIO:
        """Where a job in a process of its own says what it would say on the screen; close it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        return (self.folder / f"{job:05d}.log").open("a", buffering=1)

    def request_stop(self) -> None:
        """Ask all jobs to write their checkpoints and stop, and those that wait not to start."""
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "stop").touch()
        self._stop = True

    def stop_requested(self) -> bool:
        """Whether that was asked; the file system is not asked more often than once a second."""
        now = time.monotonic()
        if not self._stop and now - self._looked >= SECONDS_BETWEEN_LOOKS:
            self._looked, self._stop = now, (self.folder / "stop").exists()
        return self._stop

    def _path(self, job: int) -> Path:
        return self.folder / f"{job:05d}.json"


class BoardEntry(Callback):
    """Writes what a job does on the board of its multirun."""

    def __init__(self, board: Board, number: int) -> None:
        self.data: str | None = None  # folder of the data set
        self._board, self._number, self._state = board, number, JobState(RUNNING)
        self._board.write(number, self._state)

    def started(self, folder: Path) -> None:
        """The run is known."""
        self._state = replace(self._state, run=folder.name, data=self.data)
        self._board.write(self._number, self._state)

    def stop_requested(self) -> bool:
        """Whether the multirun is to stop."""
        return self._board.stop_requested()

    def end(self, status: str, reason: str = "") -> str:
        """The job has ended; returns the status."""
        self._state = replace(self._state, status=status, reason=reason)
        self._board.write(self._number, self._state)
        return status
