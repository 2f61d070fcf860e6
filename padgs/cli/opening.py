"""What the commands that open one run have in common: its folder, its data set, and where they write to."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from padgs.runs.load import LoadedRun

Run = Annotated[str, typer.Argument(help="folder of a run, finished or not, as padgs-run names it at its end")]
DataPath = Annotated[str | None, typer.Option("--data", help="where its data set is now, if not where it was")]


def opened(run: str, data: str | None) -> LoadedRun:
    """The run of a folder.

    Raises:
        ValueError, OSError: it cannot be opened.
    """
    from padgs.runs.checkpoint import CheckpointError
    from padgs.runs.load import load_run
    from padgs.runs.store import RunFolderError

    try:
        return load_run(run, data_path=data)
    except (RunFolderError, CheckpointError) as error:
        raise ValueError(str(error)) from error


@contextmanager
def naming_data(run: str) -> Iterator[None]:
    """Say of data that cannot be used whose they are, and what to do if they have moved."""
    from padgs.data.capture import DataError

    try:
        yield
    except DataError as error:
        raise ValueError(f"{error}; it is the data of {run}: if it has moved, say where to with --data") from error


@contextmanager
def writing(place: Path) -> Iterator[None]:
    """Say of a place that cannot be written to that there may be others."""
    try:
        yield
    except OSError as error:
        raise ValueError(f"cannot write {place}: {error.strerror or error}; name another place with --to") from error
