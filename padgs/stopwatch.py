"""Seconds that work takes, without those in which the process was stopped (SIGSTOP, Ctrl-Z): it did not work then.

How long a process was stopped, nothing says; only that it goes on (SIGCONT) is told. So work during which it was
stopped counts with its CPU time, at the usual ratio of both clocks.
"""

from __future__ import annotations

import signal
import time
from contextlib import suppress
from types import FrameType

_continued = 0  # how often the process went on after it was stopped


def notice_stops() -> None:
    """From now on know when this process was stopped; only the main thread can."""
    before = signal.getsignal(signal.SIGCONT)

    def go_on(number: int, frame: FrameType | None) -> None:
        global _continued
        _continued += 1
        if callable(before):
            before(number, frame)

    if getattr(before, "__name__", "") != go_on.__name__:
        with suppress(ValueError):
            signal.signal(signal.SIGCONT, go_on)


class Lap:
    """A piece of work that has just begun."""

    def __init__(self) -> None:
        self._wall, self._cpu, self._continued = time.perf_counter(), time.process_time(), _continued

    def seconds(self, wall_per_cpu: float = 1.0) -> tuple[float, float]:
        """Of wall time, and of CPU time of all threads, since it began.

        Args:
            wall_per_cpu: the usual ratio of both, for work during which the process was stopped.
        """
        wall, cpu = time.perf_counter() - self._wall, time.process_time() - self._cpu
        return (wall if self._continued == _continued else min(wall, cpu * wall_per_cpu)), cpu
