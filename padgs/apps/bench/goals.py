"""What the project asks of itself, beside what was measured.

The limits were set on two cores whose multiply-adds peak at `REFERENCE_FMA` each; a machine with half of that starts
with a handicap, which the report states and which nothing corrects for.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Any

REFERENCE_FMA = 263e9  # FLOP/s of a core
SCALES = {"ms": 1e-3, "GB": 1e9, "G/s": 1e9}  # what is measured is in seconds, bytes, ...


@dataclass(frozen=True)
class Goal:
    """One number to reach, and its place in a report: a number there, or a timing with a wall and a CPU clock."""

    name: str
    limit: float
    unit: str
    path: str
    at_least: bool = False  # else at most


GOALS = (
    Goal("draw and back, 512x256, 100k", 60, "ms", "sizes.medium.render"),
    Goal("torch renderer / native", 30, "x", "ratios.torch_renderer.cpu", at_least=True),
    Goal("memory of training, 2048x1024, 11 views", 6, "GB", "sizes.large.peak_bytes.training"),
    Goal("pairs blended per core", 2.5, "G/s", "sizes.medium.rates.forward", at_least=True),
    Goal("pairs blended backward per core", 1.0, "G/s", "sizes.medium.rates.backward", at_least=True),
    Goal("decode 10k anchors", 2, "ms", "decode_10k"),
    Goal("loss with gradient, 512x256", 8, "ms", "sizes.medium.stages.loss"),
    Goal("tiles per Gaussian, mean", 7, "tiles", "bounds.exact.mean"),
    Goal("tiles of any Gaussian", 600, "tiles", "bounds.exact.max"),
    Goal("training iteration, 512x256, 100k", 48, "ms", "sizes.medium.iteration"),
    Goal("training iteration, 256x128, 20k", 11, "ms", "sizes.small.iteration"),
    Goal("frame, 2048x1024, 1M", 250, "ms", "sizes.large.frame"),
    Goal("memory of a frame, 2048x1024, 1M", 2, "GB", "sizes.large.peak_bytes.frame"),
    Goal("tangent / erp, draw and back", 1, "x", "ratios.tangent.cpu"),
    Goal("ray / erp, draw and back", 1, "x", "ratios.ray.cpu"),
    Goal("ray, hybrid / erp, draw and back", 1, "x", "ratios.hybrid.cpu"),
)


def judge(report: dict[str, Any]) -> list[dict[str, Any]]:
    """Each goal with what was measured.

    `measured` is the median of the wall clock for times; `undisturbed` the least CPU time shared evenly among the
    threads, which is what an idle machine could do at best. `factor` > 1 is how many times better than asked.
    All are None where the size was not measured.
    """
    return [_judged(goal, report) for goal in GOALS]


def _judged(goal: Goal, report: dict[str, Any]) -> dict[str, Any]:
    try:
        value: Any = reduce(lambda part, key: part[key], goal.path.split("."), report)
    except KeyError:
        value = None
    scale = SCALES.get(goal.unit, 1.0)
    undisturbed = measured = factor = None
    if isinstance(value, dict):
        undisturbed = value["cpu"]["min"] / report["machine"]["threads"] / scale
        value = value["wall"]["median"]
    if value is not None:
        measured = value / scale
        factor = measured / goal.limit if goal.at_least else goal.limit / measured
    return {
        "name": goal.name,
        "relation": "at least" if goal.at_least else "at most",
        "limit": goal.limit,
        "unit": goal.unit,
        "measured": measured,
        "undisturbed": undisturbed,
        "factor": factor,
        "met": None if factor is None else factor >= 1,
    }
