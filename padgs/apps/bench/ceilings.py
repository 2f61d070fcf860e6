"""What this machine can do at most, measured now, and how much of it other programs take away meanwhile."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from padgs.native import cpu
from padgs.native.abi import pointer

FMA_ROUNDS = 1_000_000  # about 3 to 8 ms on each thread
TRIAD_FLOATS = 1 << 23  # per array; the two are 64 MiB, more than caches hold


@dataclass(frozen=True)
class Ceiling:
    """The best rate seen, in operations or bytes per second."""

    per_second: float  # of all threads together, by the wall clock
    per_cpu_second: float  # of one thread while all run, whatever else the machine does
    crowding: float  # median of threads x wall time / CPU time - 1; 0 on a machine of our own


def measure_ceilings(seconds: float = 0.3) -> dict[str, Ceiling]:
    """Multiply-adds ("fma", FLOP/s) and memory bandwidth ("triad", byte/s) on all of torch's threads.

    Args:
        seconds: wall time that each of the two is repeated for; five times at least.
    """
    library = cpu.library()
    arrays = torch.zeros(2, TRIAD_FLOATS)
    return {
        "fma": _best(lambda: library.padgs_measure_fma(FMA_ROUNDS), seconds),
        "triad": _best(lambda: library.padgs_measure_triad(*map(pointer, arrays), TRIAD_FLOATS), seconds),
    }


def _best(work: Callable[[], float], seconds: float) -> Ceiling:
    work()  # the first call starts the threads
    by_wall, by_cpu, crowding = [], [], []
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(by_wall) < 5:
        wall, cpu = time.perf_counter(), time.process_time()
        done = work()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        by_wall.append(done / wall)
        by_cpu.append(done / cpu)
        crowding.append(torch.get_num_threads() * wall / cpu - 1)
    return Ceiling(max(by_wall), max(by_cpu), statistics.median(crowding))
