"""Signals of a program: those that stop it, and SIGUSR1, which requests that training ends early and is scored.

Ctrl-C, SIGTERM, SIGXCPU and SIGHUP (unless nohup ignores it) raise `Interrupted` wherever the program is. Within
`Interrupt` they only set `requested`, so that a run writes its checkpoint first; a second Ctrl-C or SIGTERM stops at
once. SIGUSR1 is ignored where nothing is trained, SIGUSR2 always. Imports nothing slow: it answers from the beginning.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from types import FrameType

from padgs.checks import printable

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGXCPU)
IMPATIENT = (signal.SIGINT, signal.SIGTERM)  # the others come several times for one reason
STOP_SIGNALS = (signal.SIGUSR1,)  # may come any number of times
EXIT_STATUS = 128  # plus the number of the signal, as in shells

_received: list[int] = []  # signals that stop
_raised: list[int] = []  # those of them that raised an exception


class Interrupted(KeyboardInterrupt):
    """A run was stopped from outside; the message says what is safe. No `Exception`, so that no handler takes it."""


def answer_signals() -> None:
    """Take over the signals of this process, except those that it ignores or that other code handles."""
    if threading.current_thread() is not threading.main_thread():
        return
    for number in SIGNALS:
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _stop)
    for number in (signal.SIGUSR1, signal.SIGUSR2):
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.SIG_IGN)  # child processes inherit it


def _stop(number: int, frame: FrameType | None) -> None:
    if number in IMPATIENT or not _raised:
        _received.append(number)
        _raised.append(number)
        raise Interrupted("stopped")


@contextmanager
def ending_by_signals(advice: str = "") -> Iterator[None]:
    """Answer signals: print the advice and exit with 128 + number, silently if the reader of the output has ended.

    Output that the terminal cannot show is escaped.
    """
    answer_signals()
    if isinstance(sys.stdout, TextIOWrapper):  # of a terminal that may not be in Unicode
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        try:
            yield
        finally:
            if sys.stdout is not None:  # closed by who started this
                sys.stdout.flush()
    except BrokenPipeError:
        _exit(1)
    except BaseException as error:
        # Interrupted code may raise another exception instead, such as an ImportError by an extension module.
        if not isinstance(error, KeyboardInterrupt) and not (_raised and getattr(error, "code", 1)):
            raise
        for number in SIGNALS:  # another one, while threads end, kills without a traceback
            if signal.getsignal(number) is _stop:
                signal.signal(number, signal.SIG_DFL if number in IMPATIENT else signal.SIG_IGN)
        with suppress(OSError):  # of a terminal that was closed
            reason = str(error) if isinstance(error, KeyboardInterrupt) else ""
            print(printable(f"{reason or 'stopped'}{advice}"), file=sys.stderr)
        _raised.clear()
        _exit(EXIT_STATUS + (_received[-1] if _received else signal.SIGINT))


def _exit(status: int) -> None:
    """Exit, without errors about output that nobody reads."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    sys.exit(status)


class Interrupt:
    """Context in which signals only set `requested`, so that the owner stops when it is safe."""

    def __init__(self, also: Callable[[], bool] = lambda: False, signals: tuple[signal.Signals, ...] = SIGNALS) -> None:
        """Watch `signals`; `also` is another way to request."""
        self._signalled, self._also, self._signals = bool(_raised) and signals == SIGNALS, also, signals
        self._previous: dict[int, object] = {}

    @property
    def requested(self) -> bool:
        """True if the owner should stop."""
        return self._signalled or self._also()

    def __enter__(self) -> Interrupt:
        """Take over the signals; threads other than the main one cannot, and leave them as they are."""
        if threading.current_thread() is threading.main_thread():
            for number in self._signals:
                if number in STOP_SIGNALS or signal.getsignal(number) is not signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._request)
        return self

    def __exit__(self, *_: object) -> None:
        for number in [*self._previous]:
            self._restore(number)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self._signalled = True
        if number not in STOP_SIGNALS:
            _received.append(number)
        if number in IMPATIENT:
            self._restore(number)

    def _restore(self, number: int) -> None:
        signal.signal(number, self._previous.pop(number))  # type: ignore[arg-type]
