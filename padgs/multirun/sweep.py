"""A multirun: find the missing jobs of a sweep, launch them with a launcher of Hydra, and follow them to their ends.

In place of Hydra's sweepers: finished jobs are skipped without being composed, an error of one job ends no other, one
line sums up all jobs while they run, and Ctrl-C lets running jobs write their checkpoints.
"""

import hashlib
import os
import shlex
import shutil
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any

from hydra._internal.callbacks import Callbacks
from hydra.core.config_loader import ConfigLoader
from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from padgs import results
from padgs.checks import printable, typed, unknown
from padgs.multirun.finished import FinishedJobs, signature
from padgs.multirun.job import SHOWN_GPUS, Board, JobState, Status, complain, in_own_process, job_of_many
from padgs.multirun.overrides import expand
from padgs.multirun.slurm import NO_ANSWER, TOO_MANY, SubmissionRefused, wait_for_jobs
from padgs.results import Result, ResultError
from padgs.runs.config import RETRIES, RunOptions
from padgs.runs.console import Display, compact, duration, psnr_of, say, write
from padgs.runs.interrupt import Interrupt, Interrupted
from padgs.runs.run import RETRIED
from padgs.runs.store import RunStore, cannot_write, labels
from padgs.runs.tracking import Tracker, TrackingOptions

ATTEMPTS = 2  # of a job that began and whose process died: another job may have caused it
IDLE_LAUNCHES = 3  # in a row in which no job began
RETRIES_OF_SLURM, SECONDS_BETWEEN_RETRIES = 30, 60.0  # of a submission that Slurm did not answer
LEFT_QUEUE = "a job left Slurm's queue before it began: by scancel, or because a node cannot write to run.folder"
SECONDS_BETWEEN_TICKS = 1.0
MOST_ROWS = 40  # of the table at the end
SECONDS_BETWEEN_LINES = 30.0  # without a terminal


def sweep(config: DictConfig, loader: ConfigLoader) -> Counter[str]:
    """Do the missing part of a multirun, composed by Hydra without the swept values: each combination of these once.

    Returns status -> number of jobs, those finished before included. It may raise a ValueError for keys of `run` or
    `tracking`, and is `Interrupted` from outside; the same command continues.
    """
    typed(RunOptions, OmegaConf.to_container(config.run, resolve=True), "run")  # type: ignore[arg-type]
    jobs = expand(config.hydra.sweeper.params or {}, config.hydra.overrides.task, loader)
    multirun = Multirun(config, jobs, Console())
    _refuse_unknown_choices(multirun.jobs, config, loader)
    context = HydraContext(config_loader=loader, callbacks=Callbacks())
    launcher = Plugins.instance().instantiate_launcher(hydra_context=context, task_function=job_of_many, config=config)
    try:
        multirun.run(launcher, config.hydra.sweeper.get("max_batch_size"))
    finally:
        counts = multirun.close()
    return counts


def _refuse_unknown_choices(jobs: list[list[str]], config: DictConfig, loader: ConfigLoader) -> None:
    """Compose some jobs in which every choice of a group occurs; Hydra raises an error for the first unknown one."""
    composed: set[str] = set()
    for job in jobs:
        choices = {setting for setting in job if not setting.startswith("++")}
        if not choices <= composed:
            loader.load_sweep_config(config, job)
            composed |= choices


class Multirun:
    """The missing jobs of a sweep and their states."""

    def __init__(self, config: DictConfig, jobs: Sequence[list[str]], console: Console) -> None:
        """Look up which of the jobs, given by their overrides, are finished; the console shows the status line."""
        self.runs = Path(config.run.folder)
        self.board = Board(Path(config.hydra.sweep.dir))
        self._in_process = not in_own_process(config.hydra)
        self._die_together = "joblib" in str(config.hydra.launcher._target_)  # all jobs with one
        self._console, self._say, self._finished = console, partial(say, console), FinishedJobs(self.runs)
        if config.retry not in RETRIES:
            raise ValueError(unknown("retry", config.retry, RETRIES))
        unindexed = "hydra.searchpath" in str(OmegaConf.select(config, "hydra.overrides.hydra"))
        found = [None if unindexed else self._finished.find(job) for job in jobs]
        if config.retry == "failed":
            found = [None if known and known[0] in RETRIED else known for known in found]
        self.before = Counter(known[0] for known in found if known)
        self.jobs = [list(job) for job, known in zip(jobs, found, strict=True) if known is None]
        names = titles(jobs)
        self._titles = [title for title, known in zip(names, found, strict=True) if known is None]
        self._rows = [(title, known[1]) for title, known in zip(names, found, strict=True) if known]
        self.states = {index: JobState() for index in range(len(self.jobs))}
        self._numbers = dict.fromkeys(self.states, -1)  # of jobs on the board; a new one at each attempt
        self._reasons: set[str] = set()  # printed errors
        names = " ".join(labels(config.hydra.runtime.choices).experiments)
        digest = hashlib.sha256(repr(sorted(map(sorted, jobs))).encode()).hexdigest()[:8]
        options = typed(TrackingOptions, config.tracking if self.jobs else {"kind": "none"}, "tracking")
        self._tracker = Tracker(options, self.runs, names, self._say, f"{names or 'multirun'} {digest}")
        self._began = time.monotonic()

    def run(self, launcher: Any, batch_size: int | None) -> None:
        """Launch the missing jobs, all or some at a time; if stopped from outside, running jobs write checkpoints."""
        if self.before and self.jobs:
            self._say(self.line())
        waiting, most, retries = list(self.states), batch_size or len(self.states), 0
        attempts, launched, idle = Counter[int](), 0, 0
        try:
            self.board.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = str(cannot_write(self.board.folder, error))
            while waiting:
                self._end(waiting.pop(), JobState(Status.REFUSED, reason=reason))
        while waiting:
            size = 1 if self._in_process else batch_size or len(waiting)
            if self._die_together:  # any of these may be the cause: they go on alone, after the others
                waiting.sort(key=lambda index: attempts[index])
                size = min(size, sum(not attempts[index] for index in waiting)) or 1
            batch, waiting = waiting[:size], waiting[size:]
            self._numbers |= {index: launched + position for position, index in enumerate(batch)}
            error = self._launch(launcher, [self.jobs[index] for index in batch], launched)
            launched += len(batch)
            self._follow(batch)
            is_full = bool(TOO_MANY.search(str(error))) and len(batch) == 1  # until other jobs of the user have ended
            is_silent = isinstance(error, SubmissionRefused) and (is_full or NO_ANSWER.search(str(error)))
            if is_silent and retries < RETRIES_OF_SLURM and not self.board.stop_requested():
                waiting, retries = batch + waiting, retries + 1
                self._say(f"{error}; tried again in {SECONDS_BETWEEN_RETRIES:g} s")
                time.sleep(SECONDS_BETWEEN_RETRIES)
                continue
            if isinstance(error, SubmissionRefused):
                waiting, batch_size = batch + waiting, len(batch) // 2 if TOO_MANY.search(str(error)) else 0
                while not batch_size and waiting:
                    self._end(waiting.pop(0), JobState(Status.REFUSED, reason=str(error)))
                continue
            batch_size, retries = min(most, 2 * batch_size) if batch_size else None, 0
            if self.board.stop_requested():
                raise Interrupted("stopped, running jobs wrote their checkpoints")
            left = [index for index in batch if not self.states[index].ended]
            attempts.update(index for index in left if self.states[index].status == Status.RUNNING)
            idle = idle + 1 if all(self.states[index].status == Status.WAITING for index in batch) else 0
            gives_up = self._in_process or idle >= IDLE_LAUNCHES
            lost = {index for index in left if gives_up or attempts[index] >= ATTEMPTS}
            for index in lost:
                is_refused = self._in_process or (error and self.states[index].status == Status.WAITING)  # none began
                status = Status.REFUSED if is_refused else Status.KILLED
                began = self._in_process or self.states[index].status != Status.WAITING
                ended = "a job ended without a status" if began else "no job began"
                why = f"look for lack of memory or time, or a full disk, in its output in {self.board.folder}"
                why = f"check the free space in {self.runs}" if self._in_process else why
                reason = f"{ended}: {error or why}"
                self._end(index, replace(self.states[index], status=status, reason=reason))
            waiting += [index for index in left if index not in lost]

    def counts(self) -> Counter[str]:
        """Return status -> number of jobs, those finished before included."""
        return self.before + Counter(state.status for state in self.states.values())

    def line(self) -> str:
        """Read the board and sum it up."""
        is_open = {Status.WAITING, Status.RUNNING, Status.STOPPED}  # Slurm requeues what it preempts
        self._follow(n for n, state in self.states.items() if state.status in is_open and self._numbers[n] >= 0)
        return status_line(self.before, [*self.states.values()], time.monotonic() - self._began)

    def close(self) -> Counter[str]:
        """Print how the jobs ended; delete the board unless it explains a crash or jobs still need it."""
        for index, state in self.states.items():
            if state.status == Status.ELSEWHERE and (result := self._result(state.run)):  # done by the other process
                self.states[index] = replace(state, status=result.status)  # looked up again: it may lack scores
                self._rows.append((self._titles[index], state.run))
                self._tracker.add(self.runs / state.run)
        self._say(self.line())
        self._show_table()
        counts = self.counts()
        ended = [state.status for state in self.states.values() if state.status in results.STATUSES]
        self._tracker.finish(ended, len(self.states))
        if RETRIED & {*counts}:
            self._say("failed runs are kept as they are; retry=failed starts them again")
        alive = any(self._numbers[index] >= 0 and not state.ended for index, state in self.states.items())
        if not self._in_process and alive:  # after a second Ctrl-C: `stop` is there, and files of submitit
            self._say(f"jobs may still be running; their files and output are in {self.board.folder}")
        elif not self._in_process and ({Status.CRASHED, Status.KILLED} & {*counts} or LEFT_QUEUE in self._reasons):
            self._say(f"the output of crashed jobs is in {self.board.folder}")
        else:
            shutil.rmtree(self.board.folder, ignore_errors=True)
        return counts

    def _launch(self, launcher: Any, jobs: list[list[str]], first_number: int) -> Exception | None:
        """Run jobs to their ends; return the error of the launcher, if any."""
        try:
            if self._in_process:
                launcher.launch(jobs, initial_job_idx=first_number)
                return None
            display = Display(self._console, redraw=0.0, line=SECONDS_BETWEEN_LINES)
            with Interrupt() as stop, display:
                try:
                    with repeated(lambda: self._tick(stop, display)):
                        launch(launcher, jobs, first_number, self.board)
                finally:  # a closed terminal ends workers that are still being imported, too
                    self._tick(stop, display)
        except Exception as error:
            return error  # of the launcher or a worker process: jobs themselves raise nothing
        return None

    def _tick(self, stop: Interrupt, display: Display) -> None:
        if stop.requested:
            self.board.request_stop()
        if display.is_due:
            display.show(self.line())

    def _follow(self, indices: Iterable[int]) -> None:
        for index in list(indices):
            state = self.board.read(self._numbers[index])
            if state != self.states[index]:
                self._end(index, state)

    def _end(self, index: int, state: JobState) -> None:
        self.states[index] = state
        if state.data:
            signature(state.data)  # kept: what is stored at the end is of the data before training
        is_explained = state.status in Status.EXPLAINED or state.reason == LEFT_QUEUE
        if is_explained and state.reason not in self._reasons:
            self._reasons.add(state.reason)  # once: a missing data set is missing for all rows of a table
            complain(state.reason)
        if state.status in results.STATUSES and state.run:
            self._finished.add(self.jobs[index], state.run, state.status, state.data)
            self._rows.append((self._titles[index], state.run))
            self._tracker.add(self.runs / state.run)
            line = f"{self._titles[index] or state.run}: {', '.join(summary(state.status, self._result(state.run)))}"
            more = status_line(self.before, [*self.states.values()], time.monotonic() - self._began)
            is_last = all(one.ended for one in self.states.values())
            self._say(f"{line}; {more}" if self._in_process and not is_last else line)

    def _result(self, run: str) -> Result | None:
        with suppress(ResultError):
            return RunStore(self.runs / run).result() if run else None

    def _show_table(self) -> None:
        """Print a row for each run unless they are many, and the command that shows more."""
        found = [(title, result) for title, run in self._rows if (result := self._result(run))]
        if 1 < len(found) <= MOST_ROWS:
            table = Table("run", "result", box=SIMPLE_HEAD)
            for title, result in found:
                table.add_row(*map(printable, (title or result.run, ", ".join(summary(result.status, result)))))
            write(self._console, table)
        if found:
            what = "all" if any(result.experiments for _, result in found) else "runs"
            self._say(f"next: {shlex.join(['padgs', 'report', what, str(self.runs)])}")


def status_line(before: Counter[str], states: Collection[JobState], seconds: float) -> str:
    """Sum up a multirun in one line, from the statuses of runs finished before and the states of jobs."""
    counts = before + Counter(state.status for state in states)
    total, done, earlier = counts.total(), counts.pop(Status.OK, 0), before[Status.OK]
    parts = [f"{done} of {total} done" + (f" ({earlier} before)" if earlier else "")]
    unfinished = {name: counts.pop(name, 0) for name in Status.UNFINISHED}
    if counts.total():
        statuses = [name if number == 1 else f"{number} {name}" for name, number in counts.most_common()]
        parts.append(f"{counts.total()} failed ({', '.join(statuses)})")
    parts += [f"{number} {name}" for name, number in unfinished.items() if number]
    left = unfinished[Status.RUNNING] + unfinished[Status.WAITING]
    ran = sum(state.status in results.STATUSES for state in states)
    if left and ran:  # all runs count alike
        parts.append(f"ETA {duration(seconds * left / ran)}")
    return ", ".join(parts)


def titles(jobs: Sequence[Sequence[str]]) -> list[str]:
    """Return the settings of each job that are not the same in all jobs.

    >>> titles([["method=padgs", "++method.tau=0.3", "++seed=1"], ["method=padgs", "++method.tau=0.9", "++seed=1"]])
    ['tau = 0.3', 'tau = 0.9']
    """
    parts = [[text.lstrip("+~").partition("=") for text in job] for job in jobs]
    settings = [{key: value for key, _, value in job} for job in parts]
    keys = dict.fromkeys(key for job in settings for key in job)
    varying = [key for key in keys if len({job.get(key) for job in settings}) > 1]
    return [", ".join(f"{key.rpartition('.')[2]} = {job[key]}" for key in varying if key in job) for job in settings]


def summary(status: str, result: Result | None) -> list[str]:
    """Return quality, size and time of a run, or why it has none."""
    if result is None or not result.ok:
        return [f"{status} ({result.reason})" if result and result.reason else status]
    psnr, size = psnr_of(result), [*result.counts.items()][:1]
    parts = ["ok" if psnr is None else f"{psnr:.2f} dB", *(f"{compact(count)} {name}" for name, count in size)]
    return [*parts, f"trained {duration(result.timing.get('train_seconds', 0))}"]


def launch(launcher: Any, jobs: list[list[str]], first_number: int, board: Board) -> None:
    """Run jobs with a launcher of Hydra and wait for all of them, even if the process of one has died.

    The launchers of submitit raise the error of the first dead job and leave the others unobserved, so their jobs are
    submitted here in the same way.
    """
    if "joblib" in type(launcher).__module__:
        from joblib.externals.loky.backend.resource_tracker import ensure_running

        handler = signal.signal(signal.SIGHUP, signal.SIG_IGN)
        ensure_running()  # its helper process would end with the terminal, and report that as errors
        signal.signal(signal.SIGHUP, handler)
    if "submitit" not in type(launcher).__module__:
        launcher.launch(jobs, initial_job_idx=first_number)
        return
    import submitit
    from hydra_plugins.hydra_submitit_launcher.config import BaseQueueConf
    from submitit.core.utils import FailedJobError

    cluster, parameters = launcher._EXECUTOR, dict(launcher.params)
    folder, timeouts = parameters.pop("submitit_folder"), parameters.pop("max_num_timeout", None)
    kept = {} if timeouts is None else {f"{cluster}_max_num_timeout": timeouts}
    executor = submitit.AutoExecutor(folder=folder, cluster=cluster, **kept)
    common = OmegaConf.structured(BaseQueueConf)
    executor.update_parameters(**{key if key in common else f"{cluster}_{key}": parameters[key] for key in parameters})
    if cluster == "local" and "CUDA_VISIBLE_DEVICES" in os.environ:
        os.environ[SHOWN_GPUS] = os.environ["CUDA_VISIBLE_DEVICES"]
    ids = (f"job_id_for_{first_number + position}" for position in range(len(jobs)))
    state, key = repeat(Singleton.get_state(), len(jobs)), repeat("hydra.sweep.dir", len(jobs))
    numbers = range(first_number, first_number + len(jobs))
    try:
        submitted = executor.map_array(launcher, jobs, key, numbers, ids, state)
    except FailedJobError as error:
        raise SubmissionRefused(f"Slurm takes no job: {error}") from error
    if cluster == "slurm":
        for position in wait_for_jobs(submitted, board.stop_requested):
            left = JobState(Status.STOPPED, reason="not started" if board.stop_requested() else LEFT_QUEUE)
            if board.read(first_number + position).status == Status.WAITING:  # its log may be on another machine
                board.write(first_number + position, left)
        return
    for job in submitted:
        with suppress(Exception):  # a job without results died; the board tells which
            job.results()


@contextmanager
def repeated(action: Callable[[], None]) -> Iterator[None]:
    """Call a function every second in a thread while the context lasts."""
    over = threading.Event()

    def repeat_action() -> None:
        while not over.wait(SECONDS_BETWEEN_TICKS):
            action()

    thread = threading.Thread(target=repeat_action, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
