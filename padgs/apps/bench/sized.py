"""One workload, measured from all sides: stages, whole iterations, frames, counters, memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import torch

from padgs import clock
from padgs.apps.bench.ratios import render_both_ways
from padgs.apps.bench.stages import STAGES, amortised, growing, measured
from padgs.apps.bench.workload import OPTIONS, Size, Workload, build, sigma_quantiles
from padgs.render import Rendering, render

MANY = 500_000  # Gaussians from which a few repeats must do
FEW_REPEATS = 3
ADAPT_EVENTS = 2
WARM_UP = 2


def measure_size(size: Size, repeats: int, seed: int, progress: Callable[[str], None]) -> dict[str, Any]:
    """All of one workload, in the layout of `padgs.apps.bench.report`; `padgs.apps.bench.cost` adds floors."""
    repeats = min(repeats, FEW_REPEATS) if size.gaussians >= MANY else repeats
    clock.reset_peak_memory()
    peak = {"start": clock.peak_memory()["host"]}
    work = build(size, seed)
    progress("frames")
    frame = clock.measure(lambda: _frame(work), repeats=repeats)
    peak["frame"] = clock.peak_memory()["host"]
    progress("whole iterations")
    records = work.trainer().records()
    iteration = clock.measure(lambda: next(records), repeats=repeats, warm_up=WARM_UP)
    peak["training"] = clock.peak_memory()["host"]
    progress("whole iterations on one thread")
    with clock.threads(1):
        iteration_1_thread = clock.measure(lambda: next(records), repeats=repeats, warm_up=1)
    progress("stages")
    clock_of_stages = measured(work, repeats, WARM_UP)
    event = growing(work, ADAPT_EVENTS)
    stages = {**clock_of_stages.stages(), "adapt": amortised(event)}
    counters = _counters(work)
    progress("drawing alone")
    drawing = render_both_ways(work, repeats)
    return {
        **dataclasses.asdict(size),
        "counters": counters,
        "stages": {name: stages[name] for name in STAGES},
        "stage_sum": clock_of_stages.total(),
        "iteration": iteration,
        "iteration_1_thread": iteration_1_thread,
        "adapt_event": event,
        "frame": frame,
        "render": drawing,
        "rates": {
            way: counters["evaluated"] / stages[stage]["cpu"]["min"]
            for way, stage in (("forward", "blend"), ("backward", "blend_backward"))
        },
        "peak_bytes": peak,
    }


def _frame(work: Workload) -> Rendering:
    with torch.no_grad():
        return render(work.model.decode(work.view).gaussians, work.view, OPTIONS, backend="cpu")


def _counters(work: Workload) -> dict[str, Any]:
    counted, pixels = _frame(work).counters, work.size.width * work.size.height
    return {
        "anchors": len(work.model),
        "parameters": sum(p.numel() for p in work.model.parameters()),
        **counted,
        "evaluated_per_pixel": counted["evaluated"] / pixels,
        "contributing_per_pixel": counted["contributing"] / pixels,
        "evaluated_per_contributing": counted["evaluated"] / max(1, counted["contributing"]),
        "tiles_per_gaussian": counted["instances"] / max(1, counted["visible"]),
        "sigma": sigma_quantiles(work),
    }
