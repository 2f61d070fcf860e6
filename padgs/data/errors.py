"""What is raised when input cannot be used: always the file, the rule it breaks, and the remedy."""

from __future__ import annotations

from collections.abc import Iterable


class DataError(ValueError):
    """Input that cannot be used. The message names the file, the rule and the way out; no traceback is needed."""


def listed(names: Iterable[object], most: int = 5) -> str:
    """The first few names and how many more there are.

    >>> listed("abcdefg", most=3)
    'a, b, c and 4 more'
    """
    names = [str(name) for name in names]
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"
