"""Output of commands: messages instead of tracebacks, with the name of the run, the data set or the place concerned."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO

import typer

from padgs.runs.console import printable

if TYPE_CHECKING:
    from padgs.runs.load import LoadedRun

Run = Annotated[str, typer.Argument(help="folder of a run, finished or not, as padgs-run names it at its end")]
DataPath = Annotated[str | None, typer.Option("--data", help="new place of its data set, if it has moved")]


def show(text: str, stream: TextIO | None = None) -> None:
    """Print text that may hold names and messages from elsewhere."""
    print(printable(text), file=stream)


@contextmanager
def exit_on(*kinds: type[Exception]) -> Iterator[None]:
    """End the command with exit code 1 and the message of an exception of these kinds, without a traceback."""
    try:
        yield
    except kinds as error:
        show(f"error: {error}", sys.stderr)
        raise typer.Exit(1) from error


def open_run(run: str, data: str | None) -> LoadedRun:
    """Load the run of a folder.

    Raises:
        ValueError, OSError: it cannot be loaded.
    """
    from padgs.runs.checkpoint import CheckpointError
    from padgs.runs.load import load_run
    from padgs.runs.store import RunFolderError

    try:
        return load_run(run, data_path=data)
    except (RunFolderError, CheckpointError) as error:
        raise ValueError(str(error)) from error


@contextmanager
def name_run(run: str) -> Iterator[None]:
    """Add the run to the message of data that cannot be used, and the option for data that has moved."""
    from padgs.data.capture import DataError

    try:
        yield
    except DataError as error:
        raise ValueError(f"{error}; it is the data of {run}: if it has moved, name its place with --data") from error


@contextmanager
def name_place(place: Path, option: str = "--to") -> Iterator[None]:
    """Add the option for another place to the message of a place that cannot be written to."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise ValueError(f"cannot write {place}: {reason}; name another place with {option}") from error
