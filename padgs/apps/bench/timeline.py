"""When a device has done its work, by its own time line: queuing work takes the host next to no time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch

from padgs import clock
from padgs.native import cuda
from padgs.native.abi import Pointer
from padgs.native.loading import call_hook

QUEUED = {name for name, (arguments, _) in cuda.SIGNATURES.items() if arguments[:2] == [Pointer, Pointer]}


class Timeline:
    """Marks on the device's own time line."""

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def mark(self) -> Any:
        """Now, once the device gets here."""
        if self.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self.device))
        return event

    def seconds(self, start: Any, end: Any) -> float:
        """Between two marks that the device has reached."""
        return end - start if self.device.type != "cuda" else start.elapsed_time(end) / 1000


def timed(work: Callable[[], object], line: Timeline, repeats: int, warm_up: int) -> dict[str, float]:
    """Seconds of each of `repeats` rounds, as `padgs.clock.summary` has them."""
    for _ in range(warm_up):
        work()
    marks = []
    for _ in range(repeats):
        start = line.mark()
        work()
        marks.append((start, line.mark()))
    clock.synchronise(line.device)
    return clock.summary([line.seconds(*pair) for pair in marks])


@contextmanager
def calls_watched(line: Timeline) -> Iterator[list[tuple[str, Any, Any]]]:
    """Marks around every call that puts work into the device's queue."""
    marks: list[tuple[str, Any, Any]] = []

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        start = line.mark()
        yield
        if name in QUEUED:
            marks.append((name.removeprefix("padgs_cuda_"), start, line.mark()))

    with call_hook(stage):
        yield marks
