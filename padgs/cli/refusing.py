"""How every command says what it found, and that it cannot do what it was asked for."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

import typer

from padgs.runs.console import printable


def show(text: str, stream: TextIO | None = None) -> None:
    """Print what holds names and messages from elsewhere."""
    print(printable(text), file=stream)


@contextmanager
def refusing(*kinds: type[Exception]) -> Iterator[None]:
    """End the command where these are raised within: their message instead of a traceback, and exit code 1."""
    try:
        yield
    except kinds as error:
        show(f"error: {error}", sys.stderr)
        raise typer.Exit(1) from error
