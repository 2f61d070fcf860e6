"""The jobs of one multirun: which of them are missing, launching those, and following them to their ends."""

from __future__ import annotations

import hashlib
import shutil
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from hydra.plugins.launcher import Launcher
from omegaconf import DictConfig
from rich.console import Console

from padgs import results
from padgs.checks import typed
from padgs.multirun.board import CRASHED, ELSEWHERE, KILLED, REFUSED, RUNNING, Board, JobState
from padgs.multirun.finished import FinishedJobs
from padgs.multirun.job import complain, in_own_process
from padgs.multirun.launchers import patient
from padgs.multirun.overview import Overview, share_done, shown
from padgs.results import Result, ResultError
from padgs.runs.console import say
from padgs.runs.interrupt import Interrupt, Interrupted
from padgs.runs.run import RETRIED
from padgs.runs.store import RunStore, cannot_write, labels
from padgs.runs.tracking.tracker import SECONDS_BETWEEN_LOOKS, Tracker, TrackingOptions

ATTEMPTS = 2  # of a job whose process died: it may have been the fault of another one


class Multirun:
    """What one start of a sweep has to do, and what has become of it."""

    def __init__(self, config: DictConfig, jobs: Sequence[list[str]], console: Console) -> None:
        """Look up which of the jobs are finished.

        Args:
            config: as Hydra composed it without what is swept.
            jobs: the settings of each job.
            console: where the overview goes.
        """
        self.runs = Path(config.run.folder)
        self.board = Board(Path(config.hydra.sweep.dir))
        self._in_process = not in_own_process(config.hydra)
        self._console, self._finished = console, FinishedJobs(self.runs)
        statuses = [self._finished.status(job) for job in jobs]
        if config.retry == "failed":
            statuses = [None if status in RETRIED else status for status in statuses]
        self.before = Counter(status for status in statuses if status is not None)
        self.jobs = [list(job) for job, status in zip(jobs, statuses, strict=True) if status is None]
        self.states = {index: JobState() for index in range(len(self.jobs))}
        self._numbers = dict.fromkeys(self.states, -1)  # what the launcher calls a job; another one at each attempt
        self._said: set[str] = set()
        names = " ".join(labels(config.hydra.runtime.choices).experiments)
        digest = hashlib.sha256(repr(sorted(map(sorted, jobs))).encode()).hexdigest()[:8]
        options = typed(TrackingOptions, config.tracking if self.jobs else {"kind": "none"}, "tracking")
        self._tracker = Tracker(options, self.runs, names, self._say, f"{names or 'multirun'} {digest}")
        self._tracked: set[int] = set()  # jobs of which mlflow knows the end
        self._began = self._looked = time.monotonic()

    def run(self, launcher: Launcher, batch_size: int | None) -> None:
        """Launch what is missing.

        Args:
            launcher: of Hydra, set up.
            batch_size: jobs that it gets at a time; None: all.

        Raises:
            Interrupted: stopped from outside, after running jobs wrote their checkpoints.
        """
        if self.before and self.jobs:
            self._say(self.look().line())
        waiting, attempts, launched = list(self.states), Counter[int](), 0
        try:
            self.board.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = str(cannot_write(self.board.folder, error))
            while waiting:
                self._end(waiting.pop(), JobState(REFUSED, reason=reason))
        while waiting:
            size = 1 if self._in_process else batch_size or len(waiting)
            batch, waiting = waiting[:size], waiting[size:]
            self._numbers |= {index: launched + position for position, index in enumerate(batch)}
            error = self._launch(launcher, batch, launched)
            launched += len(batch)
            self._follow(batch)
            if self.board.stop_requested():
                raise Interrupted("stopped, running jobs wrote their checkpoints")
            left = [index for index in batch if not self.states[index].ended]
            began = [index for index in left if self.states[index].status == RUNNING]
            attempts.update(began or left)
            lost = {index for index in left if self._in_process or attempts[index] >= ATTEMPTS}
            for index in lost:
                status = REFUSED if self._in_process else KILLED
                reason = f"a job did not say how it ended: {error or f'is there room in {self.runs}?'}"
                self._end(index, replace(self.states[index], status=status, reason=reason))
            waiting += [index for index in left if index not in lost]
            self._track()
            if self._in_process and waiting and any(self.states[index].status != REFUSED for index in batch):
                self._say(self.look().line())

    def look(self) -> Overview:
        """How things stand."""
        self._follow(index for index, state in self.states.items() if not state.ended and self._numbers[index] >= 0)
        progress = {
            index: share_done(self.runs / state.run)
            for index, state in self.states.items()
            if state.status == RUNNING and state.run
        }
        return Overview(self.before, dict(self.states), time.monotonic() - self._began, progress)

    def close(self) -> Overview:
        """Say how it ended; the board stays only where it can tell what went wrong, or jobs need it."""
        for index, state in self.states.items():
            if state.status == ELSEWHERE and (result := self._result(state)):  # by now it was finished there
                self._end(index, replace(state, status=result.status))
        seen = self.look()
        self._say(seen.line())
        self._track()
        found = [result for state in self.states.values() if (result := self._result(state))]
        self._tracker.finish(found, len(self.states))
        if RETRIED & {*seen.counts}:
            self._say("failed runs are kept as they are; retry=failed starts them again")
        alive = any(self._numbers[index] >= 0 and not state.ended for index, state in self.states.items())
        if not self._in_process and alive:  # after a second Ctrl-C: `stop` is there, and what submitit starts jobs from
            self._say(f"jobs may still be running; what they need, and say, is in {self.board.folder}")
        elif not self._in_process and {CRASHED, KILLED} & {*seen.counts}:
            self._say(f"what crashed jobs said is in {self.board.folder}")
        else:
            shutil.rmtree(self.board.folder, ignore_errors=True)
        return seen

    def _launch(self, launcher: Launcher, batch: Sequence[int], first_number: int) -> Exception | None:
        """Have jobs run, and come back when none of them does any more; what went wrong with the launcher, if any."""
        jobs = [self.jobs[index] for index in batch]
        try:
            if self._in_process:
                launcher.launch(jobs, initial_job_idx=first_number)
                return None
            with Interrupt() as stop, patient(), shown(self.look, lambda: self._pass_on(stop), self._console):
                launcher.launch(jobs, initial_job_idx=first_number)
                self._pass_on(stop)
        except Exception as error:
            return error  # of the launcher or a worker process: jobs themselves raise nothing
        return None

    def _pass_on(self, stop: Interrupt) -> None:
        if stop.requested:
            self.board.request_stop()
        elif time.monotonic() - self._looked >= SECONDS_BETWEEN_LOOKS:
            self._track()

    def _track(self) -> None:
        """Have runs mirrored that are running or have ended since the last time."""
        self._looked = time.monotonic()
        for index, state in list(self.states.items()):
            if index not in self._tracked and state.run and (self.runs / state.run / results.CONFIG_NAME).exists():
                self._tracker.update(self.runs / state.run)
                if state.ended:
                    self._tracked.add(index)

    def _follow(self, indices) -> None:
        """Read from the board what became of jobs."""
        for index in list(indices):
            state = self.board.read(self._numbers[index])
            if state != self.states[index]:
                self._end(index, state)

    def _end(self, index: int, state: JobState) -> None:
        self.states[index] = state
        if state.status in (REFUSED, CRASHED, KILLED, ELSEWHERE) and state.reason not in self._said:
            self._said.add(state.reason)  # once: a data set that is missing is missing for all rows of a table
            complain(state.reason)
        if state.finished and state.run:
            self._finished.add(self.jobs[index], state.run, state.status, state.data)

    def _result(self, state: JobState) -> Result | None:
        with suppress(ResultError):
            return RunStore(self.runs / state.run).result() if state.run else None

    def _say(self, text: str) -> None:
        say(self._console, text)
