"""Files that say what each job of a multirun does, wherever it runs, and the line that sums them up.

`<run.folder>/.multirun/START/` holds one small file per job, which only that job writes, and `stop`, which asks all
jobs to stop. Nothing else couples a job to its parent, so it may run on any machine that sees the folder.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Collection
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TextIO

from padgs import results
from padgs.runs.console import duration
from padgs.runs.run import Callback

WAITING, RUNNING, OK = "waiting", "running", "ok"
# A job ends with a status of `padgs.results.STATUSES`, or without a result:
REFUSED = "refused"  # the configuration or the data cannot be used; there is no run
CRASHED = "crashed"  # by an error in the program; the traceback is in the job's output
KILLED = "killed"  # its process died
ELSEWHERE = "elsewhere"  # another process works on this run
STOPPED = "stopped"  # on request, after it wrote its checkpoint
UNFINISHED = (RUNNING, WAITING, ELSEWHERE, STOPPED)  # neither done nor failed
SECONDS_BETWEEN_LOOKS = 1.0  # at `stop`


@dataclass(frozen=True)
class JobState:
    """State of one job."""

    status: str = WAITING
    run: str = ""  # name of its run folder, once it is known
    reason: str = ""  # why it failed
    data: str | None = None  # folder of the data set, absolute; None for a generated scene

    @property
    def ended(self) -> bool:
        """True if the job does nothing more."""
        return self.status not in (WAITING, RUNNING)


class Board:
    """The folder of one multirun."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._looked, self._stop = -float("inf"), False

    def write(self, job: int, state: JobState) -> None:
        """Write the state of a job; a full disk must not end the job, so nothing is raised."""
        with suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
            draft = self._path(job).with_suffix(".draft")  # never read half-written
            draft.write_text(json.dumps(asdict(state)))
            draft.replace(self._path(job))

    def read(self, job: int) -> JobState:
        """Return the state of a job; waiting, if it has written none."""
        try:
            return JobState(**json.loads(self._path(job).read_bytes()))
        except (OSError, ValueError, TypeError):
            return JobState()

    def output(self, job: int) -> TextIO:
        """Open the file for the screen output of a job in a process of its own; the caller closes it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        return (self.folder / f"{job:05d}.log").open("a", buffering=1)

    def request_stop(self) -> None:
        """Ask running jobs to write their checkpoints and stop, and waiting jobs not to start."""
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "stop").touch()
        self._stop = True

    def stop_requested(self) -> bool:
        """Return whether a stop was requested; looks at the file system at most once a second."""
        now = time.monotonic()
        if not self._stop and now - self._looked >= SECONDS_BETWEEN_LOOKS:
            self._looked, self._stop = now, (self.folder / "stop").exists()
        return self._stop

    def _path(self, job: int) -> Path:
        return self.folder / f"{job:05d}.json"


class BoardEntry(Callback):
    """Callback of a run that writes the state of its job."""

    def __init__(self, board: Board, number: int) -> None:
        self.data: str | None = None  # folder of the data set
        self._board, self._number, self._state = board, number, JobState(RUNNING)
        self._board.write(number, self._state)

    def started(self, folder: Path) -> None:
        """Write the name of the run folder."""
        self._state = replace(self._state, run=folder.name, data=self.data)
        self._board.write(self._number, self._state)

    def stop_requested(self) -> bool:
        """Return whether the multirun is to stop."""
        return self._board.stop_requested()

    def end(self, status: str, reason: str = "") -> str:
        """Write and return the status that the job ended with."""
        self._state = replace(self._state, status=status, reason=reason)
        self._board.write(self._number, self._state)
        return status


def status_line(before: Counter[str], states: Collection[JobState], seconds: float) -> str:
    """Sum up a multirun in one line, from the statuses of runs finished before and the states of jobs.

    >>> states = [JobState("ok"), JobState("nan"), JobState("running"), JobState()]
    >>> status_line(Counter(ok=2), states, 60.0)
    '3 of 6 done (2 before), 1 failed (nan), 1 running, 1 waiting, ETA 1:00'
    """
    counts = before + Counter(state.status for state in states)
    total, done, earlier = counts.total(), counts.pop(OK, 0), before[OK]
    parts = [f"{done} of {total} done" + (f" ({earlier} before)" if earlier else "")]
    unfinished = {name: counts.pop(name, 0) for name in UNFINISHED}
    if counts.total():
        statuses = [name if number == 1 else f"{number} {name}" for name, number in counts.most_common()]
        parts.append(f"{counts.total()} failed ({', '.join(statuses)})")
    parts += [f"{number} {name}" for name, number in unfinished.items() if number]
    left = unfinished[RUNNING] + unfinished[WAITING]
    ran = sum(state.status in results.STATUSES for state in states)
    if left and ran:  # all runs count alike
        parts.append(f"ETA {duration(seconds * left / ran)}")
    return ", ".join(parts)
