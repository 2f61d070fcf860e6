"""Parts of all commands: errors as one line, text for the terminal, arguments that name a run."""

import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, TextIO

import typer

from padgs.checks import printable
from padgs.runs.interrupt import ending_by_signals

Run = Annotated[str, typer.Argument(help="folder of a run, as padgs-run names it at its end")]
Model = Annotated[str, typer.Argument(help="folder of a run, or a .ply, .spz, .sog, .splat or .ksplat of Gaussians")]
Rays = Annotated[str, typer.Option(help="how to draw a file of Gaussians: exact, or ewa as ordinary viewers do")]
Transform = Annotated[str, typer.Option(help="file's world to the scene's: 12 or 16 numbers, a file, or identity")]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda")]
DataPath = Annotated[str | None, typer.Option("--data", help="data set, if it has moved; for Gaussians also a run")]
Format = Annotated[str, typer.Option(help="format of the data set; auto: find out")]
Mask = Annotated[str, typer.Option(help="auto, none, inverted, rows:959/1024, a file or folder; 255 marks used pixels")]
Depth = Annotated[str, typer.Option(help="auto, or none: ignore depth maps")]
Points = Annotated[str, typer.Option(help="auto, random, or a PLY, LAS or E57 file of starting points")]
Images = Annotated[str, typer.Option(help="image folder, if not the usual one")]
Cameras = Annotated[str, typer.Option(help="all, or panoramas: leave out images of other cameras")]
Split = Annotated[str, typer.Option(help="how to choose held-out views: auto, files, every or all (none held out)")]
OF_DATA = ("mask", "points", "images", "split", "depth", "cameras", "format")  # keys of `data`, and options
MAX_SEED, MAX_THREADS = 2**32 - 1, max(64, 4 * (os.cpu_count() or 1))


def show(text: str, stream: TextIO | None = None) -> None:
    """Print text that may hold names and messages from elsewhere."""
    print(printable(text), file=stream)


def without_traceback(command: Callable[..., None]) -> Callable[..., None]:
    """Wrap a command: an error ends it with a line and exit code 1, a signal as well."""

    @wraps(command)
    def wrapped(**options: Any) -> None:
        warnings.formatwarning = lambda message, *_, **__: printable(f"warning: {message}\n")  # without a line of code
        try:
            with ending_by_signals():
                _refuse_empty(command, options)
                command(**options)
        except (typer.Exit, BrokenPipeError):  # typer ends in silence where the reader of the output has ended
            raise
        except (ValueError, OSError, RuntimeError, MemoryError) as error:
            names = [name for name, value in options.items() if isinstance(value, str)]
            show(f"error: {as_options(_message(error, **options), names)}", sys.stderr)
            raise typer.Exit(1) from error

    return wrapped


def _refuse_empty(command: Callable[..., None], options: dict[str, Any]) -> None:
    """Raise a ValueError for an empty text where that is not the default of an option or argument."""
    for name, parameter in signature(command).parameters.items():
        value = options[name]
        if value != parameter.default and (value == "" or isinstance(value, list) and "" in value):
            raise ValueError(f"{name} is empty (is a variable of the shell unset?); give a value, or leave it out")


def _message(error: Exception, *, run: str = "", beside: str = "", **_: object) -> str:
    """Return the message of an error, with the way out of data of a run that cannot be used."""
    from padgs.data.capture import DataError

    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}"
    given = [*filter(None, (run, beside))]
    is_of_a_file = str(error).startswith(tuple(f"{Path(one)} " for one in given))  # of Gaussians
    if run and isinstance(error, DataError) and not (is_of_a_file or Path(run).is_file()):
        runs = " or ".join(given)
        return f"{error}; it is the data of {runs}: if it has moved, name its place with --data"
    return str(error) or "out of memory"


def as_options(message: str, names: Iterable[str]) -> str:
    """Return a message with options of these names instead of the keys of a run that mean the same.

    >>> as_options("set data.mask=inverted, or data.width=512", ["mask"])
    'set --mask inverted, or data.width=512'
    """
    known = "|".join(name for name in OF_DATA if name in {*names}) or "(?!)"
    message = message.replace("run.device=", "--device ")
    return re.sub(rf"data\.({known})\b(=?)", lambda found: f"--{found[1]}{' ' * bool(found[2])}", message)


def check_range(low: float, high: float, **options: float | None) -> None:
    """Raise a ValueError "--NAME is VALUE; it must be from LOW to HIGH" for a value outside."""
    for name, value in options.items():
        if value is not None and not low <= value <= high:
            raise ValueError(f"--{name.replace('_', '-')} is {value}; it must be from {low} to {high}")


@contextmanager
def name_place(place: Path, option: str = "--to") -> Iterator[None]:
    """Add the option for another place to the message of a place that cannot be written to."""
    try:
        yield
    except OSError as error:
        if error.errno is None:  # of an image or a library, which says itself what to do
            raise
        is_blocked = isinstance(error, FileExistsError)  # by a file where a folder must be
        reason = f"{error.filename} is not a folder" if is_blocked else error.strerror or error
        raise ValueError(f"cannot write {place}: {reason}; name another place with {option}") from error
