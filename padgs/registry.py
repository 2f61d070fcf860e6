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
        ValueError: `name` is not registered; the message lists the names that are.

    >>> lookup({"sqrt": "math:sqrt"}, "sqrt", "function")(9.0)
    3.0
    """
    if name not in registry:
        raise ValueError(f"unknown {kind} {name!r}; known: {', '.join(sorted(registry))}")
    module, _, attribute = registry[name].partition(":")
    return getattr(import_module(module), attribute)
