"""What the project asks of itself, beside what was measured.

The limits were set on two cores whose multiply-adds peak at `REFERENCE_FMA` each; a machine with half of that starts
with a handicap, which the report states and which nothing corrects for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

REFERENCE_FMA = 263e9  # FLOP/s of a core
MS, GIGA = 1e-3, 1e9


@dataclass(frozen=True)
class Goal:
    """One number to reach. `read` finds it in a report: a number, or a timing with a wall and a CPU clock."""

    name: str
    limit: float
    unit: str
    source: str
    read: Callable[[dict[str, Any]], Any]
    scale: float = 1.0  # what is read is divided by it, to be in `unit`
    at_least: bool = False  # else at most


def _size(name: str, *path: str) -> Callable[[dict[str, Any]], Any]:
    def read(report: dict[str, Any]) -> Any:
        value = report["sizes"][name]
        for key in path:
            value = value[key]
        return value

    return read


def _against_erp(projection: str) -> Callable[[dict[str, Any]], Any]:
    return lambda report: report["ratios"][projection]["cpu"]


FOUNDATION, RENDERER = "issue 2, speed and memory", "issue 3, speed and memory"
METHODS = "issue 5, speed and memory"
GOALS = (
    Goal("draw and back, 512x256, 100k", 60, "ms", FOUNDATION, _size("medium", "render"), MS),
    Goal("torch renderer / native", 30, "x", FOUNDATION, lambda r: r["ratios"]["torch_renderer"]["cpu"], at_least=True),
    Goal("training iteration, 512x256, 100k", 120, "ms", FOUNDATION, _size("medium", "iteration"), MS),
    Goal(
        "memory of training, 2048x1024, 11 views", 6, "GB", FOUNDATION, _size("large", "peak_bytes", "training"), GIGA
    ),
    Goal("pairs blended per core", 2.5, "G/s", RENDERER, _size("medium", "rates", "forward"), GIGA, at_least=True),
    Goal(
        "pairs blended backward per core",
        1.0,
        "G/s",
        RENDERER,
        _size("medium", "rates", "backward"),
        GIGA,
        at_least=True,
    ),
    Goal("decode 10k anchors", 2, "ms", RENDERER, lambda r: r["decode_10k"], MS),
    Goal("loss with gradient, 512x256", 8, "ms", RENDERER, _size("medium", "stages", "loss"), MS),
    Goal("tiles per Gaussian, mean", 7, "tiles", RENDERER, lambda r: r["bounds"]["exact"]["mean"]),
    Goal("tiles of any Gaussian", 600, "tiles", RENDERER, lambda r: r["bounds"]["exact"]["max"]),
    Goal("training iteration, 512x256, 100k", 48, "ms", RENDERER, _size("medium", "iteration"), MS),
    Goal("training iteration, 256x128, 20k", 11, "ms", RENDERER, _size("small", "iteration"), MS),
    Goal("frame, 2048x1024, 1M", 250, "ms", RENDERER, _size("large", "frame"), MS),
    Goal("memory of a frame, 2048x1024, 1M", 2, "GB", RENDERER, _size("large", "peak_bytes", "frame"), GIGA),
    Goal("tangent / erp, draw and back", 1, "x", METHODS, _against_erp("tangent")),
    Goal("ray / erp, draw and back", 1, "x", METHODS, _against_erp("ray")),
    Goal("ray, hybrid / erp, draw and back", 1, "x", METHODS, _against_erp("hybrid")),
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
        value = goal.read(report)
    except KeyError:
        value = None
    undisturbed = None
    if isinstance(value, dict):
        undisturbed = value["cpu"]["min"] / report["machine"]["threads"] / goal.scale
        value = value["wall"]["median"]
    measured = None if value is None else value / goal.scale
    factor = None
    if measured is not None:
        factor = measured / goal.limit if goal.at_least else goal.limit / measured
    return {
        "name": goal.name,
        "relation": "at least" if goal.at_least else "at most",
        "limit": goal.limit,
        "unit": goal.unit,
        "source": goal.source,
        "measured": measured,
        "undisturbed": undisturbed,
        "factor": factor,
        "met": None if factor is None else factor >= 1,
    }
