"""For whoever wants to know what each native call takes: a stage around every one of them, for a while."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

Stage = Callable[[str], AbstractContextManager[object]]  # name of a function -> what it is called within

_stages: list[Stage] = []  # the last one counts


@contextmanager
def watched(stage: Stage) -> Iterator[None]:
    """Within this context every call of a native library is made within `stage(its name)`."""
    _stages.append(stage)
    try:
        yield
    finally:
        _stages.pop()


class Watchable:
    """A native library whose calls can be watched."""

    def __init__(self, loaded: ctypes.CDLL) -> None:
        self._loaded = loaded

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._loaded, name)
        if not _stages:
            return function

        def call(*arguments: Any) -> Any:
            with _stages[-1](name):
                return function(*arguments)

        return call
