"""One run as a job: the only one of a process, or one of a multirun, in the process that launched it or another one.

`<run.folder>/.multirun/START/` holds one small file per job of a multirun, which only that job writes, and `stop`,
which asks all jobs to stop. Nothing else couples a job to its parent, so it runs on any machine that sees the folder.
"""

import json
import os
import re
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TextIO

from hydra.conf import HydraConf
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from padgs.checks import ConfigError, unknown
from padgs.multirun.composition import typed_config
from padgs.multirun.finished import signature
from padgs.results import SMALLEST_STATED, Result
from padgs.runs.config import RunConfig
from padgs.runs.console import say
from padgs.runs.interrupt import Interrupted, answer_signals
from padgs.runs.load import load_run
from padgs.runs.run import REPORTED, Callback, Scene, is_out_of_memory, load_scene, memory_reason, run, start
from padgs.runs.smallest import find_smallest
from padgs.runs.store import RunBusy

EXPECTED = (*REPORTED, OmegaConfBaseException)  # errors whose message suffices without a traceback
SECONDS_BETWEEN_LOOKS = 1.0  # at `stop`
SHOWN_GPUS = "PADGS_SHOWN_GPUS"  # CUDA_VISIBLE_DEVICES of the command, which submitit replaces by the first of all


class Status:
    """Statuses of a job, besides those of `padgs.results.STATUSES`; OK is one of them."""

    WAITING, RUNNING, OK = "waiting", "running", "ok"
    REFUSED = "refused"  # the configuration or the data cannot be used; there is no run
    CRASHED = "crashed"  # by an error in the program; the traceback is in the job's output
    KILLED = "killed"  # its process died
    ELSEWHERE = "elsewhere"  # another process works on this run
    STOPPED = "stopped"  # on request, after it wrote its checkpoint
    EXPLAINED = (REFUSED, CRASHED, KILLED, ELSEWHERE)  # with a reason that is printed
    UNFINISHED = (RUNNING, WAITING, ELSEWHERE, STOPPED)  # neither done nor failed


@dataclass(frozen=True)
class JobState:
    """State of one job."""

    status: str = Status.WAITING
    run: str = ""  # name of its run folder, once it is known
    reason: str = ""  # why it failed
    data: str | None = None  # folder of the data set, absolute; None for a generated scene

    @property
    def ended(self) -> bool:
        """True if the job does nothing more."""
        return self.status not in (Status.WAITING, Status.RUNNING)


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
        with suppress(OSError, ValueError, TypeError):
            return JobState(**json.loads(self._path(job).read_bytes()))
        return JobState()

    def output(self, job: int) -> TextIO:
        """Open the file for the screen output of a job in a process of its own; the caller closes it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        return (self.folder / f"{job:05d}.log").open("a", buffering=1, encoding="utf-8")

    def request_stop(self) -> None:
        """Ask running jobs to write their checkpoints and stop, and waiting jobs not to start."""
        self._stop = True
        with suppress(OSError):  # of a full disk; jobs of the same terminal receive its signals themselves
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / "stop").touch()

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
        self._before = board.read(number).run  # of a job that Slurm put back into the queue
        self._board, self._number, self._state = board, number, JobState(Status.RUNNING, self._before)
        self._board.write(number, self._state)

    def started(self, folder: Path) -> None:
        """Write the name of the run folder; a ConfigError if the job began as another run."""
        if self._before not in ("", folder.name):
            why = "conf/ or the data have changed meanwhile: restore them, or start the sweep again"
            raise ConfigError(f"this job began as {self._before}, and would now be {folder.name}; {why}")
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


def job_of_many(composed: DictConfig) -> str:
    """Do one run of a multirun and return its status; only an interruption is raised, so that the other jobs go on."""
    answer_signals()  # of a process of its own
    if SHOWN_GPUS in os.environ:
        os.environ["CUDA_VISIBLE_DEVICES"] = os.environ[SHOWN_GPUS]
    hydra = HydraConfig.get()
    board = Board(Path(hydra.sweep.dir))
    with ExitStack() as stack:
        alone = in_own_process(hydra)
        console = Console(file=stack.enter_context(board.output(hydra.job.num)), width=120) if alone else Console()
        entry = BoardEntry(board, hydra.job.num)
        try:
            if entry.stop_requested():
                raise Interrupted("not started")
            config = typed_config(composed, hydra.runtime.choices)
            entry.data = None if config.data.path is None else str(Path(config.data.path).absolute())
            if entry.data and not alone:
                signature(entry.data)  # kept: what is stored at the end is of the data before training
            scene = load_scene(config, start(config))
            result = run(config, console, entry, scene, brief=not alone)
            search_smallest(config, scene, result, console, entry)
            return entry.end(result.status, result.reason)
        except KeyboardInterrupt as error:
            entry.end(Status.STOPPED, str(error))
            if alone:
                return Status.STOPPED
            raise
        except Exception as error:
            if isinstance(error, EXPECTED) or is_out_of_memory(error):
                return entry.end(Status.ELSEWHERE if isinstance(error, RunBusy) else Status.REFUSED, _message(error))
            say(console, traceback.format_exc())
            return entry.end(Status.CRASHED, f"{type(error).__name__}: {error}")


def search_smallest(config: RunConfig, scene: Scene, result: Result, console: Console, callback: Callback) -> None:
    """Search for the smallest model as good as that of a run which ended well, if that is requested."""
    if config.smallest == "on" and result.ok:
        folder = Path(config.run.folder) / result.run
        finished = load_run(folder, data_path=config.data.path, device=config.run.device)
        finished.scene = scene  # whose panoramas are loaded
        find_smallest(finished, SMALLEST_STATED, console, callback.stop_requested)


def complain(message: str) -> None:
    """Print an error on the error stream."""
    say(Console(stderr=True), f"error: {message}", "red")


@contextmanager
def exit_on_errors() -> Iterator[None]:
    """Exit with code 1 and the message of an expected error, without a traceback."""
    try:
        yield
    except BrokenPipeError:  # the reader of the output has ended
        raise
    except Exception as error:
        if not (isinstance(error, (HydraException, *EXPECTED)) or is_out_of_memory(error)):
            raise
        complain(_message(error))
        sys.exit(1)


def _message(error: Exception) -> str:
    if isinstance(error, MissingConfigException):
        group, _, name = str(error.missing_cfg_file).removesuffix(".yaml").rpartition("/")
        return unknown(group, name, error.options or ())
    if isinstance(error, OverrideParseException):
        key, _, value = error.override.lstrip("+").partition("=")
        rule = "values with spaces or other signs than letters, digits and -_./+ need quotes"
        return f"{key}={value} cannot be read: {rule}, e.g. padgs-run '{key}=\"VALUE\"'"
    if several := re.match("Ambiguous value for argument '(?:\\+\\+)?(.*)'\n", str(error)):
        return f"{several[1]} has several values; give -m for one run each"
    if not isinstance(error, EXPECTED) and is_out_of_memory(error):
        return f"out of memory: {memory_reason(error)}"
    return f"{error}\n{error.__cause__}" if isinstance(error, HydraException) and error.__cause__ else str(error)


def in_own_process(hydra: DictConfig | HydraConf) -> bool:
    """Return whether the launcher runs jobs in other processes; joblib does not if it runs one at a time."""
    return not str(hydra.launcher._target_).endswith("BasicLauncher") and hydra.launcher.get("n_jobs") != 1
