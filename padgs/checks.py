"""Checks of options. What is refused is named with its value and the rule, or with the names that are known."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any


def check(options: object, rule: str, holds: Callable[[Any], bool], *names: str) -> None:
    """Refuse options of these names for which a rule does not hold.

    Raises:
        ValueError: "NAME is VALUE; it must be RULE".
    """
    for name in names:
        value = getattr(options, name)
        if not holds(value):
            raise ValueError(f"{name} is {value}; it must be {rule}")


def check_known(options: object, **known: Collection[str]) -> None:
    """Refuse options that are none of the names known for them.

    Raises:
        ValueError: "unknown NAME VALUE; known: ..."
    """
    for name, names in known.items():
        value = getattr(options, name)
        if value not in names:
            raise ValueError(f"unknown {name} {value!r}; known: {', '.join(names)}")
