"""Time, memory and the machine they were measured on, as plain dicts that go into results as they are.

Wall time is how long the user waits, CPU time is what the work costs. On a shared machine they differ, and then the
smallest of several repeats is the most reliable.
"""

import datetime
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import torch

T = TypeVar("T")
Device = torch.device | str


class Lap:
    """Wall and CPU time since construction."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def seconds(self) -> tuple[float, float]:
        """Return (wall, CPU) seconds since construction; CPU time is summed over all threads of the process."""
        return time.perf_counter() - self._wall, time.process_time() - self._cpu


def synchronise(device: Device = "cpu") -> None:
    """Wait until the device has finished its queue; otherwise only the launch of GPU work is timed."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


def timed(work: Callable[[], T], device: Device = "cpu") -> tuple[T, float]:
    """Return the value of `work()` and its seconds: CPU time of the process, or on a GPU wall time of queued work."""
    synchronise(device)
    lap = Lap()
    value = work()
    synchronise(device)
    return value, lap.seconds()[torch.device(device).type == "cpu"]


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Limit torch to `count` threads inside the context."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def measure(work: Callable[[], Any], *, repeats: int = 10, warm_up: int = 2, device: Device = "cpu") -> dict[str, Any]:
    """Time `work()` several times: {"repeats": n, "wall": {"median", "p95", "min"}, "cpu": {the same}} in seconds."""
    for _ in range(warm_up):
        work()
    laps = []
    for _ in range(repeats):
        synchronise(device)
        lap = Lap()
        work()
        synchronise(device)
        laps.append(lap.seconds())
    wall, cpu = map(list, zip(*laps, strict=True))
    return {"repeats": repeats, "wall": summary(wall), "cpu": summary(cpu)}


def summary(seconds: list[float]) -> dict[str, float]:
    """Return median, 95th percentile (the smallest value that 95 % do not exceed) and minimum.

    >>> summary([3.0, 1.0, 2.0])
    {'median': 2.0, 'p95': 3.0, 'min': 1.0}
    """
    ordered = sorted(seconds)
    rank = -(-95 * len(ordered) // 100)
    return {"median": statistics.median(ordered), "p95": ordered[rank - 1], "min": ordered[0]}


def reset_peak_memory(device: Device = "cpu") -> None:
    """Reset the peak, so that each run of a process has its own (host: Linux only)."""
    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    with suppress(OSError):  # not Linux, or not allowed: the peak is that of the whole process
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory(device: Device = "cpu") -> dict[str, Any]:
    """Return peak bytes since `reset_peak_memory` or the start: of the process, and of tensors on a GPU (or None)."""
    on_device = torch.cuda.max_memory_allocated(device) if torch.device(device).type == "cuda" else None
    # VmHWM and not ru_maxrss where there is one: ru_maxrss survives exec, so a process that a large one started
    # reports its parent's peak.
    kilobytes = int(linux_value("/proc/self/status", "VmHWM").partition(" ")[0] or 0)
    other = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return {"peak_memory_bytes": 1024 * kilobytes or other, "peak_device_memory_bytes": on_device}


def cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine(device: Device = "cpu") -> dict[str, Any]:
    """Return hardware, versions, code and date, which a measurement is read with."""
    gpu = torch.device(device) if torch.device(device).type == "cuda" else None
    return {
        "cpu": linux_value("/proc/cpuinfo", "model name") or platform.processor() or platform.machine(),
        "cores": cores(),
        "threads": torch.get_num_threads(),
        "memory": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "gpu": torch.cuda.get_device_name(gpu) if gpu else None,
        "os": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "cuda": torch.version.cuda if gpu else None,
        "padgs": metadata.version("padgs"),
        "commit": commit(),
        "date": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
    }


@cache  # later the files may be of another commit than the running code
def commit(folder: Path = Path(__file__).resolve().parent.parent) -> str | None:  # noqa: B008
    """Return the commit of the checkout of this code, with "+" if files differ from it; None outside a checkout."""
    if not (folder / ".git").exists():
        return None  # without this check, an installed package would report whatever repository lies around it
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty=+", "--abbrev=40", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def linux_value(file: str, key: str) -> str:
    """Return the first value of a key in a file of the Linux kernel; empty elsewhere."""
    try:
        lines = Path(file).read_text().splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), "")
