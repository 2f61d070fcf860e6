"""One run as a job: the only one of a process, or one of a multirun, in the process that launched it or another one."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path

from hydra.conf import HydraConf
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from padgs.apps.viewer.process import serve_training
from padgs.checks import unknown
from padgs.multirun.board import CRASHED, ELSEWHERE, REFUSED, STOPPED, Board, BoardEntry
from padgs.multirun.composition import typed_config
from padgs.results import SMALLEST_STATED, Result
from padgs.runs.config import RunConfig
from padgs.runs.console import say
from padgs.runs.interrupt import Interrupted, answer_signals
from padgs.runs.load import load_run
from padgs.runs.run import REPORTED, Callback, Scene, load_scene, run, start
from padgs.runs.smallest import find_smallest
from padgs.runs.store import RunBusy, RunStore

EXPECTED = (*REPORTED, OmegaConfBaseException)  # errors whose message suffices without a traceback


def job_of_many(composed: DictConfig) -> str:
    """Do one run of a multirun; raises nothing but an interruption, so that the other jobs go on.

    Returns:
        Its status, one of `padgs.results.STATUSES` or of `padgs.multirun.board`.
    """
    answer_signals()  # of a process of its own
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
            with served_scene(config) as scene:
                result = run(config, console, entry, scene, brief=not alone)
            search_smallest(config, scene, result, console, entry)
            return entry.end(result.status, result.reason)
        except KeyboardInterrupt as error:
            entry.end(STOPPED, str(error))
            if alone:
                return STOPPED
            raise
        except EXPECTED as error:
            return entry.end(ELSEWHERE if isinstance(error, RunBusy) else REFUSED, str(error))
        except Exception as error:
            say(console, traceback.format_exc())
            return entry.end(CRASHED, f"{type(error).__name__}: {error}")


@contextmanager
def served_scene(config: RunConfig) -> Iterator[Scene]:
    """Load the scene of a run, and show the run in the browser while the context lasts if that is requested."""
    scene = load_scene(config, start(config))
    folder = RunStore.of(config, scene).path
    with serve_training(folder, config.data.path, config.run.device) if config.run.view else nullcontext():
        yield scene


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
    except MissingConfigException as error:
        group, _, name = str(error.missing_cfg_file).removesuffix(".yaml").rpartition("/")
        complain(unknown(group, name, error.options or ()))
        sys.exit(1)
    except OverrideParseException as error:
        key, _, value = error.override.lstrip("+").partition("=")
        rule = "values with spaces or any of ,;:{}[]()'\" need quotes"
        complain(f"{key}={value} cannot be read: {rule}, e.g. padgs-run '{key}=\"VALUE\"'")
        sys.exit(1)
    except HydraException as error:
        complain("\n".join(map(str, filter(None, (error, error.__cause__)))))
        sys.exit(1)
    except EXPECTED as error:
        complain(str(error))
        sys.exit(1)


def in_own_process(hydra: DictConfig | HydraConf) -> bool:
    """Return whether the launcher runs jobs in other processes than its own."""
    return not str(hydra.launcher._target_).endswith("BasicLauncher")
