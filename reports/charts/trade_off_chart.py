"""The picture of speed against accuracy: quality over training time, and over time per frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from textwrap import fill
from typing import Any

from padgs.reports.charts import time_chart
from padgs.reports.charts.axis import Axis
from padgs.reports.charts.drawing import Chart, Tips, figure, lay_out, png, styled, svg
from padgs.reports.charts.palette import ALPHA, SOFT
from padgs.reports.charts.panel import ARROW, FIXED, Panel, area
from padgs.reports.charts.trade_off import TradeOff, trade_offs
from padgs.reports.gathered import Gathered
from padgs.reports.measures import COSTS

PANELS = (("train_seconds", "training time", "s"), ("frame_ms", "time per frame", "ms"))  # cost, words, unit
ON_CPU = ("cpu_seconds", "training time on the CPU", "s")  # in place of the first, where it is known of all
WIDE, NARROW = (5.3, 4.6), (3.7, 4.2)  # inches of a panel: side by side on a page, one above the other on a phone
LARGEST = {WIDE: 300.0, NARROW: 170.0}  # points^2 of the mark with the most Gaussians
LETTERS = 55  # of a line below a narrow figure


def charts(gathered: Gathered) -> list[Chart]:
    """Speed against accuracy, and quality over training time where runs left a log."""
    made = [drawn for trade_off in trade_offs(gathered) for drawn in (chart(trade_off), time_chart.chart(trade_off))]
    return [drawn for drawn in made if drawn is not None]


@styled
def chart(trade_off: TradeOff) -> Chart:
    """Two panels that share the axis of quality, with a name at each mark.

    Axes show where methods differ (`axis.window`); who lies beyond stands at the margin with its number. The area of a
    mark is proportional to the number of Gaussians. A released program is a small ring, joined to its corrected method;
    variants of a method are faint. The Pareto front is that of all but released programs.
    """
    (wide, tips, _), (narrow, narrow_tips, _) = (drawn(trade_off, size) for size in (WIDE, NARROW))
    written = svg(wide, trade_off.name, tips), png(wide), trade_off.notes, trade_off.numbers
    return Chart(trade_off.name, trade_off.title, *written, narrow=svg(narrow, trade_off.name, narrow_tips))


@styled
def drawn(trade_off: TradeOff, size: tuple[float, float]) -> tuple[Any, Tips, list[tuple[Panel, list[Any]]]]:
    """The figure with panels of a size, what its marks say, and each panel with the names in it."""
    quality, columns = trade_off.qualities[0], len(PANELS) if size == WIDE else 1
    made, axes = figure(columns, len(PANELS) // columns, *size)
    shown = (ON_CPU, *PANELS[1:]) if trade_off.on_cpu else PANELS
    tips, costs = Tips(), [COSTS[cost] for cost, _, _ in shown]
    there = [point for point in trade_off.points if point.value(quality) is not None]
    y_axis = Axis.of([point.value(quality) or 0.0 for point in there], worse=-1)
    x_axes = [Axis.of([x for point in there if (x := point.value(cost))], True, worse=1) for cost in costs]
    panels = []
    for own, cost, x_axis, (_, words, unit) in zip(axes.flat, costs, x_axes, shown, strict=True):
        own.set_xlabel(f"{words}, {unit} ↓")
        own.set_ylabel(f"{quality.column.title}, dB ↑")
        panels.append(Panel(own, trade_off, cost, quality, unit, x_axis, y_axis))
    scale = LARGEST[size] / max([1.0, *(mark.gaussians for one in panels for mark in one.marks)])
    for one in panels:
        one.draw(scale, tips)
    handles, conditions = _handles(panels, scale), _conditions(trade_off)
    look = {"ncols": 2, "title": fill(conditions, LETTERS)} if columns == 1 else {"ncols": 8, "title": conditions}
    made.legend(handles=handles, loc="outside lower center", fontsize=8, title_fontsize=8, **look)
    lay_out(made, trade_off.title)
    return made, tips, [(one, one.name(scale)) for one in panels]


def _handles(panels: Sequence[Panel], scale: float) -> list[Any]:
    """What is drawn and needs a word."""
    from matplotlib.lines import Line2D
    from matplotlib.ticker import EngFormatter

    def dot(size: float, label: str, **look: Any) -> Line2D:
        look = {"marker": "o", "color": SOFT[0], "markeredgewidth": 0} | look
        return Line2D([], [], linestyle="none", markersize=math.sqrt(size), label=label, **look)

    marks = [mark for one in panels for mark in one.marks]
    counts = [mark.gaussians for mark in marks if mark.gaussians]
    examples = dict.fromkeys((_round(min(counts)), _round(max(counts)))) if counts else ()
    handles = [dot(area(count, scale), f"{EngFormatter(sep='')(count)} Gaussians") for count in examples]
    if any(mark.role != "release" and not mark.gaussians and not any(mark.sides) for mark in marks):
        handles.append(dot(FIXED, "without Gaussians", marker="D"))
    if any(mark.role == "variant" for mark in marks):
        handles.append(dot(90.0, "variant of a method", alpha=ALPHA["variant"]))
    if any(mark.role == "release" for mark in marks):
        handles.append(dot(FIXED, "program as released", markerfacecolor="none", markeredgewidth=1.0))
    if any(any(mark.sides) for mark in marks):
        handles.append(dot(ARROW, "beyond the axis", marker="v"))
    return [*handles, Line2D([], [], color=SOFT[0], linewidth=0.9, label="Pareto front")]


def _conditions(trade_off: TradeOff) -> str:
    """What the runs have in common, for who sees the picture alone."""
    parts = ["up and to the left is better"]
    for column in ("resolution", "length"):
        known = trade_off.runs[column].unique()
        parts += [known[0]] if len(known) == 1 else []
    seeds = trade_off.runs["seed"].nunique()
    return ", ".join([*parts, *([f"bars: standard deviation over {seeds} seeds"] if seeds > 1 else [])])


def _round(count: float) -> float:
    """The nearest of 1, 2, 5, 10, ... below.

    >>> _round(344_000), _round(105_000)
    (200000.0, 100000.0)
    """
    decade = 10.0 ** math.floor(math.log10(count))
    return decade * max(digit for digit in (1, 2, 5) if digit * decade <= count)
