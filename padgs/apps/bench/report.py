"""Everything that `padgs bench` measures, as one dict that goes into JSON as it is. Times are in seconds.

schema         version of this layout
machine        hardware, versions, commit and date (`padgs.clock.machine`), instruction set, load average
options        of the command
ceilings       fma (FLOP/s) and triad (byte/s), before and after all else: see `padgs.apps.bench.ceilings.Ceiling`
noise          how far wall and CPU time are apart where they should agree: "parallel", "single" and the larger,
               "worst"; 0 is none, `limit` is what is tolerated
noisy          worst > limit: other programs took the processors, and no number here should be published
sizes          name -> one workload:
  width, height, gaussians (asked for), views
  counters     what the renderer counted, ratios of these, anchors, parameters, sizes of the Gaussians in pixels
  stages       stage of `padgs.apps.bench.stages.STAGES` -> {wall, cpu: {median, p95, min}} per iteration; where there
               is a cost model also operations, bytes, floor (CPU seconds), bound, fraction (floor / least CPU)
  stage_sum    the iteration that the stages are parts of, without adapt
  iteration    `padgs.training.loop.Trainer`, undisturbed;  iteration_1_thread: the same on one thread
  adapt_event  growing and pruning once; the stage adapt is its share of one iteration
  frame        decode and draw without gradients
  render       draw fixed Gaussians and go back to their gradients
  rates        evaluated pairs per CPU second, forward and backward
  peak_bytes   resident memory of the process: at the start, drawing frames, training
decode_10k     decoding 10 000 anchors forward
bounds         tiles per Gaussian by latitude: see `padgs.apps.bench.tile_counts`
ratios         see `padgs.apps.bench.ratios`, and threads: one thread against all
isas           instruction set -> render, if asked for
targets        see `padgs.apps.bench.goals`
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from padgs import clock
from padgs.apps.bench import goals, isas, ratios, tile_counts
from padgs.apps.bench.ceilings import Ceiling, measure_ceilings
from padgs.apps.bench.cost import add_floors
from padgs.apps.bench.sized import measure_size
from padgs.apps.bench.workload import SIZES, Size, build, refuse_unknown
from padgs.native import cpu

SCHEMA = 1
NOISE_LIMIT = 0.25
DECODED_ANCHORS = 10_000  # the number that the target for decoding is stated for


@dataclass(frozen=True)
class BenchOptions:
    """What to measure and how often."""

    sizes: tuple[str, ...] = ("small", "medium")
    repeats: int = 10
    threads: int | None = None  # None: one for each core that this process may use
    seed: int = 0
    isas: bool = False  # also on each instruction set
    ceiling_seconds: float = 0.4

    def __post_init__(self) -> None:
        refuse_unknown(self.sizes)
        for name in ("repeats", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} is {value}; it must be at least 1")


QUICK = BenchOptions(sizes=("quick",), repeats=3, ceiling_seconds=0.05)


def measure_all(options: BenchOptions, progress: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Measure; `progress` is told what is being measured. The layout of the result is described above.

    Raises:
        OSError: the native library is not there.
    """
    cpu.library()
    with clock.threads(options.threads or clock.machine()["cores"]):
        return _measure_all(options, progress)


def _measure_all(options: BenchOptions, progress: Callable[[str], None]) -> dict[str, Any]:
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    isa = cpu.library().padgs_isa().decode()
    progress("the machine's ceilings")
    before = measure_ceilings(options.ceiling_seconds)
    sizes = {}
    for name in options.sizes:
        sizes[name] = measure_size(
            SIZES[name], options.repeats, options.seed, lambda what, n=name: progress(f"{n}: {what}")
        )
    progress("tiles by latitude")
    tiles = tile_counts.tiles_by_latitude(count=50_000 if options.repeats > QUICK.repeats else 20_000)
    progress("decoding 10 000 anchors")
    small = build(Size(256, 128, 5 * DECODED_ANCHORS), options.seed)
    with torch.no_grad():
        decode = clock.measure(lambda: small.model.decode(small.view), repeats=options.repeats)
    progress("the same work in two ways")
    # The largest size up to the medium one, if any: beyond it, doing things in several ways takes too long.
    reference = next(name for name in ("medium", "small", "quick", "large") if name in options.sizes)
    pairs = ratios.ratios(build(SIZES[reference], options.seed), build(SIZES["quick"], options.seed), options.repeats)
    report: dict[str, Any] = {
        "schema": SCHEMA,
        "machine": {**clock.machine(), "isa": isa, "load": load},
        "options": dataclasses.asdict(options),
        "reference": reference,
        "sizes": sizes,
        "decode_10k": decode,
        "bounds": tiles,
        "ratios": pairs,
    }
    if options.isas:
        progress("each instruction set")
        report["isas"] = isas.by_instruction_set(SIZES[reference], options.repeats, options.seed)
    progress("the machine's ceilings, once more")
    _judge(report, before, measure_ceilings(options.ceiling_seconds))
    return report


def _judge(report: dict[str, Any], before: dict[str, Ceiling], after: dict[str, Ceiling]) -> None:
    """What can only be said at the end: how fast the machine is, how noisy it was, which targets are met."""
    best = {name: max(before[name], after[name], key=lambda c: c.per_cpu_second) for name in before}
    report["ceilings"] = {name: dataclasses.asdict(ceiling) for name, ceiling in best.items()}
    for size in report["sizes"].values():
        add_floors(size, best)
    single = [size["iteration_1_thread"] for size in report["sizes"].values()]
    noise = {
        "limit": NOISE_LIMIT,
        "parallel": max(before["fma"].crowding, after["fma"].crowding),
        "single": max(timing["wall"]["median"] / timing["cpu"]["median"] - 1 for timing in single),
    }
    noise["worst"] = max(noise["parallel"], noise["single"])
    report["noise"], report["noisy"] = noise, noise["worst"] > NOISE_LIMIT
    work = report["sizes"][report["reference"]]
    report["ratios"]["threads"] = ratios.compared(
        "1 thread", f"{report['machine']['threads']} threads", work["iteration_1_thread"], work["iteration"]
    )
    report["targets"] = goals.judge(report)
