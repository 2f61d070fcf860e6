"""How every command says that it cannot do what it was asked for."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer


@contextmanager
def refusing(*kinds: type[Exception]) -> Iterator[None]:
    """End the command where these are raised within: their message instead of a traceback, and exit code 1."""
    try:
        yield
    except kinds as error:
        print(f"error: {error}", file=sys.stderr)
        raise typer.Exit(1) from error
