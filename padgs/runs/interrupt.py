"""Signals of a run: Ctrl-C or SIGTERM write the checkpoint and stop, a second one stops at once.

SIGUSR1 requests that training ends early and is scored.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType

INTERRUPTED = 130  # exit code of a command that a signal ended
SIGNALS = (signal.SIGINT, signal.SIGTERM)  # cluster schedulers send SIGTERM before they kill
STOP_SIGNALS = (signal.SIGUSR1,)  # may come any number of times


class Interrupted(KeyboardInterrupt):
    """A run was stopped from outside; the message says what is safe. No `Exception`, so that no handler takes it."""


class Interrupt:
    """Context in which signals only set `requested`, so that the owner stops when it is safe."""

    def __init__(self, also: Callable[[], bool] = lambda: False, signals: tuple[signal.Signals, ...] = SIGNALS) -> None:
        """Watch `signals`; `also` is another way to request."""
        self._signalled, self._also, self._signals = False, also, signals
        self._previous: dict[int, object] = {}

    @property
    def requested(self) -> bool:
        """True if the owner should stop."""
        return self._signalled or self._also()

    def __enter__(self) -> Interrupt:
        """Take over the signals; threads other than the main one cannot, and leave them as they are."""
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._request) for number in self._signals}
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def _request(self, number: int, frame: FrameType | None) -> None:
        self._signalled = True
        if number not in STOP_SIGNALS:
            self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._previous = {}
