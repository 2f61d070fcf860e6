"""Charts of speed against accuracy: quality over training time and over time per frame, and over time from the logs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

from padgs.reports import methods
from padgs.reports.charts import time_chart
from padgs.reports.charts.axis import Axis
from padgs.reports.charts.drawing import ALPHA, INK, PAPER, SOFT, Chart, color_of, figure, lay_out, styled, tip
from padgs.reports.charts.labels import Label, Line, weight_of, write_labels
from padgs.reports.charts.trade_off import Point, TradeOff, pareto, trade_offs
from padgs.reports.measures import COSTS, Measure
from padgs.reports.selection import RunSet

FRAME_TIME = ("frame_ms", "time per frame", "ms")  # cost, words, unit
TRAINING_TIME, CPU_TIME = ("train_seconds", "training time", "s"), ("cpu_seconds", "training time on the CPU", "s")
SIZE = (5.3, 4.6)  # inches of a panel
# Areas of marks in points^2: with the most Gaussians, with few, without an area of meaning, and of arrow heads.
LARGEST, SMALLEST, FIXED, ARROW = 300.0, 25.0, 30.0, 70.0


@dataclass(frozen=True)
class Mark:
    """A point in a panel."""

    point: Point
    role: str  # see `TradeOff.role`
    x: float  # cost
    y: float  # quality
    at: tuple[float, float]  # position: (x, y), or in the margin
    sides: tuple[int, int]  # end of each axis that it lies beyond: -1, 0 or 1

    @property
    def gaussians(self) -> float:
        """The number that its area shows: 0 for releases, in the margin, and for methods without Gaussians."""
        return 0.0 if self.role == "release" or any(self.sides) else self.point.gaussians

    def area(self, scale: float) -> float:
        """Return points^2, with `scale` points^2 per Gaussian."""
        return ARROW if any(self.sides) else area(self.gaussians, scale) if self.gaussians else FIXED

    def radius(self, scale: float) -> float:
        """Return the radius in points."""
        return math.sqrt(self.area(scale)) / 2


@dataclass
class Panel:
    """Matplotlib axes and the marks of a trade-off."""

    axes: Any
    trade_off: TradeOff
    cost: Measure
    unit: str  # of the cost
    x_axis: Axis
    y_axis: Axis
    lines: list[Line] = field(default_factory=list)  # that labels should not cover

    @cached_property
    def marks(self) -> list[Mark]:
        """A mark for each point with a quality and a positive cost."""
        found = []
        for point in self.trade_off.points:
            x, y = point.value(self.cost), point.value(self.trade_off.quality)
            if x and y is not None:
                at, sides = zip(
                    *((a.position(v), a.side(v)) for a, v in ((self.x_axis, x), (self.y_axis, y))), strict=True
                )
                found.append(Mark(point, self.trade_off.role(point.preset), x, y, at, sides))
        return found

    def draw(self, scale: float) -> None:
        """Draw axes, the Pareto front, links, standard deviations and marks, with `scale` points^2 per Gaussian."""
        self.x_axis.apply(self.axes.xaxis)
        self.y_axis.apply(self.axes.yaxis)
        self._draw_front()
        presets = [point.preset for point in self.trade_off.points]
        for mark in self.marks:
            color = color_of(mark.point.preset, presets)
            if mark.role == "release" and (twin := self._twin(mark)):
                self._line([mark.at, twin.at], color=color, linewidth=0.7, alpha=0.35, zorder=1.4)
            for ends in self._deviations(mark):
                self._line(ends, color=color, linewidth=0.8, alpha=0.6 * ALPHA[mark.role], zorder=2)
            numbers = [f"{name}: {brief(c.value, 4)}" for name, c in mark.point.numbers.items() if c.value is not None]
            look = {"s": mark.area(scale), "gid": tip("\n".join([mark.point.title, *numbers])), **_look(mark, color)}
            self.axes.scatter(*mark.at, clip_on=False, **look)

    def label(self, scale: float) -> list[Any]:
        """Write labels, main presets first, and return the texts; call it when the layout is fixed.

        A release has no label beside its corrected method. Labels in the margin have numbers.
        """
        labels = []
        for mark in sorted(self.marks, key=lambda mark: mark.role != "main"):
            if mark.role == "release" and self._twin(mark) and not any(mark.sides):
                continue
            x_side, y_side = mark.sides
            values = [f"{mark.y:.1f} dB"] * bool(y_side) + [f"{brief(mark.x)} {self.unit}"] * bool(x_side)
            text = "\n".join([methods.short(mark.point.title, mark.point.preset), ", ".join(values)]).strip()
            labels.append(Label(text, mark.at, mark.radius(scale), weight_of(mark.point.preset, mark.role)))
        return write_labels(self.axes, labels, [(*mark.at, mark.radius(scale)) for mark in self.marks], self.lines)

    def _draw_front(self) -> None:
        """Draw the Pareto front of all ranked points but releases, up to the end of the window."""
        rivals = [m for m in self.marks if m.role != "release" and m.point.preset not in self.trade_off.unranked]
        positions = {(mark.x, mark.y): mark.at for mark in rivals}
        corners = [positions[point] for point in pareto([*positions])]
        corners += [(max(self.x_axis.window[1], corners[-1][0]), corners[-1][1])] if corners else []
        steps = [corner for (_, y), (x, top) in pairwise(corners) for corner in ((x, y), (x, top))]
        self._line([*corners[:1], *steps], color=SOFT[0], linewidth=0.9, zorder=1.5)

    def _line(self, corners: Line, **look: Any) -> None:
        if corners:
            self.lines.append(corners)
            self.axes.plot(*zip(*corners, strict=True), **look)

    def _twin(self, mark: Mark) -> Mark | None:
        twin = self.trade_off.corrected(mark.point)
        return next((other for other in self.marks if other.point is twin), None)

    def _deviations(self, mark: Mark) -> list[Line]:
        """Return lines of a standard deviation to each side, along axes where a mark with several seeds is in place."""
        measures = (self.cost, self.trade_off.quality)
        x_std, y_std = (mark.point.numbers[measure.column.title].std for measure in measures)
        (x, y), (x_side, y_side) = mark.at, mark.sides
        along: list[Line] = [[(max(x - x_std, x / 10), y), (x + x_std, y)]] if x_std and not x_side else []
        return along + ([[(x, y - y_std), (x, y + y_std)]] if y_std and not y_side else [])


def charts(run_set: RunSet) -> list[Chart]:
    """Return speed against accuracy, and quality over training time for runs with a log."""
    made = [drawn for trade_off in trade_offs(run_set) for drawn in (chart(trade_off), time_chart.chart(trade_off))]
    return [drawn for drawn in made if drawn is not None]


def chart(trade_off: TradeOff) -> Chart:
    """Return two panels with a common axis of quality and a label at each mark.

    Axes show where methods differ (`axis.window`); marks beyond stand in the margin, with their numbers. The area of a
    mark is proportional to the number of Gaussians. Releases are small rings, linked to their corrected method, and not
    in the Pareto front. Variants are faint.
    """
    return Chart(trade_off.name, trade_off.title, draw(trade_off)[0], trade_off.notes, trade_off.numbers)


@styled
def draw(trade_off: TradeOff) -> tuple[Any, list[tuple[Panel, list[Any]]]]:
    """Return the figure, and each panel with its labels."""
    quality, shown = trade_off.quality, (CPU_TIME if trade_off.on_cpu else TRAINING_TIME, FRAME_TIME)
    made, axes = figure(len(shown), 1, *SIZE)
    there = [point for point in trade_off.points if point.value(quality) is not None]
    y_axis = Axis.of([point.value(quality) or 0.0 for point in there], worse=-1)
    panels = []
    for own, (cost, words, unit) in zip(axes.flat, shown, strict=True):
        own.set_xlabel(f"{words}, {unit} ↓")
        own.set_ylabel(f"{quality.column.title}, dB ↑")
        x_axis = Axis.of([x for point in there if (x := point.value(COSTS[cost]))], True, worse=1)
        panels.append(Panel(own, trade_off, COSTS[cost], unit, x_axis, y_axis))
    scale = LARGEST / max([1.0, *(mark.gaussians for one in panels for mark in one.marks)])
    for one in panels:
        one.draw(scale)
    look = {"title": _conditions(trade_off), "ncols": 8, "fontsize": 8, "title_fontsize": 8}
    made.legend(handles=_handles(panels, scale), loc="outside lower center", **look)
    lay_out(made, trade_off.title)
    return made, [(one, one.label(scale)) for one in panels]


def area(gaussians: float, scale: float) -> float:
    """Return the points^2 of a mark, with `scale` points^2 per Gaussian."""
    return max(scale * gaussians, SMALLEST)


def brief(value: float, digits: int = 3) -> str:
    """Return a number with so many digits, or all digits before the point.

    >>> brief(24.8512), brief(123456.0)
    ('24.9', '123,456')
    """
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.{digits}g}"


def _look(mark: Mark, color: str) -> dict[str, Any]:
    look: dict[str, Any] = {"alpha": ALPHA[mark.role], "zorder": 3 if mark.role == "main" else 2.5}
    if any(mark.sides):  # an arrow head towards the true position
        look["marker"] = (3, 0, math.degrees(math.atan2(mark.sides[1], mark.sides[0])) - 90)
    elif mark.role != "release" and not mark.gaussians:
        look["marker"] = "D"
    if mark.role == "release":
        return look | {"facecolors": "none", "edgecolors": color, "linewidths": 1.0}
    ours = weight_of(mark.point.preset, mark.role) == "bold"
    return look | {"facecolors": color, "edgecolors": INK[0] if ours else PAPER[0], "linewidths": 1.2 if ours else 0.5}


def _handles(panels: Sequence[Panel], scale: float) -> list[Any]:
    """Return the legend of what is drawn."""
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
    """Return the conditions that all runs share, so that the image can be read alone."""
    parts = ["up and to the left is better"]
    for column in ("resolution", "length"):
        known = trade_off.runs[column].unique()
        parts += [known[0]] if len(known) == 1 else []
    seeds = trade_off.runs["seed"].nunique()
    return ", ".join([*parts, *([f"bars: standard deviation over {seeds} seeds"] if seeds > 1 else [])])


def _round(count: float) -> float:
    """Return the largest of 1, 2, 5, 10, ... up to a count.

    >>> _round(344_000), _round(105_000)
    (200000.0, 100000.0)
    """
    decade = 10.0 ** math.floor(math.log10(count))
    return decade * max(digit for digit in (1, 2, 5) if digit * decade <= count)
