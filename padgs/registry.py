"""Registries are plain dicts of name -> "package.module:attribute"; nothing is imported before it is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any


def lookup(registry: Mapping[str, str], name: str, kind: str) -> Any:
    """Import and return the entry `name` of `registry`.

    Args:
        registry: name -> "package.module:attribute".
        name: the entry wanted.
        kind: what the registry holds, for the error message ("backend", "method", ...).

    Raises:
        ValueError: `name` is not registered (the message lists the names that are), or is of another package that
            fails, or ends the program, when it is imported.

    >>> lookup({"sqrt": "math:sqrt"}, "sqrt", "function")(9.0)
    3.0
    """
    if name not in registry:
        raise ValueError(f"unknown {kind} {name!r}; known: {', '.join(sorted(registry))}")
    module, _, attribute = registry[name].partition(":")
    try:
        return getattr(import_module(module), attribute)
    except (Exception, SystemExit) as error:
        if module.partition(".")[0] == "padgs":
            raise
        why = f"{type(error).__name__}: {error}"
        raise ValueError(f"{kind} {name} cannot be used: {registry[name]} of another package fails ({why})") from error
