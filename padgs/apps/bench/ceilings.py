"""The ceilings of a machine, measured in the same run, and the least time of each stage at these ceilings."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from padgs import clock
from padgs.methods.anchors.anchors import PaDGSOptions
from padgs.native import cpu
from padgs.native.abi import pointer

FMA_ROUNDS = 1_000_000  # 3 to 8 ms on each thread
TRIAD_FLOATS = 1 << 23  # per array; both arrays are 64 MiB, more than caches hold
DEVICE_BYTES = {"cuda": 1 << 30, "cpu": 1 << 23}  # copied to measure the memory bandwidth of a device
EXP_LANES = 8  # lane instructions of the exponential's polynomial
BLEND_LANES, BLEND_BACKWARD_LANES = 20 + EXP_LANES, 55 + EXP_LANES  # per evaluated pair
ADAM_BYTES = 28  # per scalar: read parameter, gradient and two moments; write all but the gradient
ADAM_OPERATIONS = 12


@dataclass(frozen=True)
class Ceilings:
    """The highest rates measured: per second of one CPU thread while all threads run, or per second of a GPU."""

    arithmetic: float  # FLOP/s
    memory: float  # byte/s
    crowding: float = 0.0  # median of threads x wall time / CPU time - 1: the share that other programs take

    def floor(self, operations: float, size: float) -> tuple[float, str]:
        """Return the least seconds for operations and bytes, and which of them binds: "arithmetic" or "memory"."""
        arithmetic, memory = operations / self.arithmetic, size / self.memory
        return (arithmetic, "arithmetic") if arithmetic >= memory else (memory, "memory")

    def best(self, other: Ceilings) -> Ceilings:
        """Return the higher rates and the larger crowding of two measurements."""
        return Ceilings(*(max(pair) for pair in zip(vars(self).values(), vars(other).values(), strict=True)))


def measure_ceilings(device: torch.device, seconds: float = 0.3) -> Ceilings:
    """Measure arithmetic and memory bandwidth; on the CPU with all of torch's threads, `seconds` of wall time each."""
    if device.type != "cpu":
        return device_ceilings(device)
    library, arrays = cpu.library(), torch.zeros(2, TRIAD_FLOATS)
    fma, crowding = _best_rate(lambda: library.padgs_measure_fma(FMA_ROUNDS), seconds)
    triad, _ = _best_rate(lambda: library.padgs_measure_triad(*map(pointer, arrays), TRIAD_FLOATS), seconds)
    return Ceilings(fma, triad, crowding)


def device_ceilings(device: torch.device) -> Ceilings:
    """Measure a float32 matrix product without TF32, and a copy, by torch."""
    count = DEVICE_BYTES[device.type] // 4
    source, matrix = torch.empty(count, device=device), torch.randn(int(count**0.5) // 2, 2048, device=device)
    target, square = torch.empty_like(source), matrix.T @ matrix
    copy = clock.measure(lambda: target.copy_(source), repeats=10, device=device)["wall"]["min"]
    multiply = clock.measure(lambda: torch.mm(matrix.T, matrix, out=square), repeats=5, device=device)["wall"]["min"]
    return Ceilings(2 * matrix.numel() * matrix.shape[1] / multiply, 2 * 4 * count / copy)


def costs(size: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Return the least (operations, bytes) of stages with a cost model, by counters of a size; a multiply-add is 2."""
    model, counters, pixels = PaDGSOptions(), size["counters"], size["width"] * size["height"]
    anchors, gaussians, instances, pairs, scalars = (
        counters[name] for name in ("anchors", "gaussians", "instances", "evaluated", "parameters")
    )
    # First layers of three networks, and 1 + 3 + 7 outputs per Gaussian in the second: 14.1 k in the paper's model.
    decode = 2 * anchors * model.hidden * (3 * model.inputs + 11 * model.offsets)
    return {
        "decode": (decode, 284 * anchors + 56 * gaussians),
        "project": (400 * gaussians, 120 * gaussians),
        "sort": (0, 64 * gaussians + 24 * instances),
        # Instance 12 B and footprint 64 B; six floats per pixel.
        "blend": (2 * BLEND_LANES * pairs, 76 * instances + 24 * pixels),
        "loss": (3 * 700 * pixels, 3 * 50 * pixels),
        # Sums of gradients written and read.
        "blend_backward": (2 * BLEND_BACKWARD_LANES * pairs, (76 + 128) * instances + 36 * pixels),
        "project_backward": (1000 * gaussians, 200 * gaussians),
        "decode_backward": (2 * decode, 568 * anchors + 112 * gaussians),
        "optimizer": (ADAM_OPERATIONS * scalars, ADAM_BYTES * scalars),
    }


def add_floors(size: dict[str, Any], ceilings: Ceilings) -> None:
    """Write the least seconds ("floor") and their "bound" beside each stage of a size, and their sum."""
    floors = {name: ceilings.floor(*cost) for name, cost in costs(size).items()}
    for name in floors.keys() & size["stages"].keys():
        size["stages"][name] |= dict(zip(("floor", "bound"), floors[name], strict=True))
    size["floor"] = sum(seconds for seconds, _ in floors.values())


def _best_rate(work: Callable[[], float], seconds: float) -> tuple[float, float]:
    """Return the highest rate per CPU second, and the crowding."""
    work()  # the first call starts the threads
    rates, crowding = [], []
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(rates) < 5:
        lap, done = clock.Lap(), work()
        wall, used = lap.seconds()
        rates.append(done / used)
        crowding.append(torch.get_num_threads() * wall / used - 1)
    return max(rates), statistics.median(crowding)
