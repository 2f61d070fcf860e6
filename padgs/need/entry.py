"""The whole of `padgs need`, for whoever asks for it: a command, or a run at its end."""

from __future__ import annotations

from collections.abc import Callable

from rich.console import Console

from padgs.need.outcome import keep
from padgs.need.search import Search
from padgs.need.summary import show
from padgs.runs.console import say
from padgs.runs.load import LoadedRun


def search(run: LoadedRun, epsilon: float, console: Console, asked: Callable[[], bool] = lambda: False) -> None:
    """Search, keep what may lose epsilon dB beside the run, and say what was found.

    Args:
        run: a finished one.
        epsilon: one of `padgs.results.NEED_LOSSES`.
        console: where it is said.
        asked: whether to stop, besides signals.

    Raises:
        ValueError: the run is none that can be searched, or its data set has changed since.
        RunBusy: another process searches it.
        Interrupted, Failure, CheckpointError, RunFolderError: as `padgs.need.outcome.keep` does.
    """
    run.refuse_other_data()
    with run.files:
        kept = keep(Search(run, console.print, asked), epsilon)
    show(kept.need, console)
    say(console, run.folder.resolve().with_name(kept.run), "bold")
