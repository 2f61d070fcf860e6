"""What signals mean to a run. Ctrl-C: finish the step, write the checkpoint, then stop; a second one: now.

SIGUSR1, which any number may be sent of, means to training: enough, end well and score.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType

INTERRUPTED = 130  # exit code of a command that a signal ended
SIGNALS = (signal.SIGINT, signal.SIGTERM)  # SIGTERM is what cluster schedulers send before they kill
ENOUGH = (signal.SIGUSR1,)


class Interrupted(KeyboardInterrupt):
    """A run was stopped from outside; the message says what is safe. Not an error, so that nothing takes it for one."""


class Interrupt:
    """While this context lasts, a signal only sets `requested`; its owner looks there when it is safe to stop."""

    def __init__(
        self, asked: Callable[[], bool] = lambda: False, signals: tuple[signal.Signals, ...] = SIGNALS
    ) -> None:
        """Not requested yet; `asked` is another way to request it."""
        self._signalled, self._asked, self._signals = False, asked, signals
        self._before: dict[int, object] = {}

    @property
    def requested(self) -> bool:
        """Whether to stop."""
        return self._signalled or self._asked()

    def __enter__(self) -> Interrupt:
        """Take over the signals; only the main thread can, elsewhere they keep their meaning."""
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._request) for number in self._signals}
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def _request(self, number: int, frame: FrameType | None) -> None:
        self._signalled = True
        if number not in ENOUGH:
            self._restore()

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._before = {}
