"""One panel of speed against accuracy: marks, spreads, links, the Pareto front and names."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

from padgs.reports import methods
from padgs.reports.charts import names
from padgs.reports.charts.axis import Axis
from padgs.reports.charts.drawing import Tips
from padgs.reports.charts.names import Line, Name
from padgs.reports.charts.palette import ALPHA, INK, PAPER, SOFT, color_of, weight_of
from padgs.reports.charts.trade_off import Point, TradeOff, pareto
from padgs.reports.measures import Measure

SMALLEST = 25.0  # points^2 of a mark that would be too small to see
FIXED = 30.0  # points^2 of a mark whose area says nothing: a released program, a method without Gaussians
ARROW = 70.0  # points^2 of the arrow head of a mark at the margin


@dataclass(frozen=True)
class Mark:
    """A point in the panel."""

    point: Point
    role: str  # as `TradeOff.role` says
    x: float  # its cost
    y: float  # its quality
    at: tuple[float, float]  # where it is drawn: there, or at the margin
    sides: tuple[int, int]  # beyond which side of either axis it lies: -1, 0 or 1

    @property
    def gaussians(self) -> float:
        """How many its area says: 0 for a released program, at the margin, and in a method without any."""
        return 0.0 if self.role == "release" or any(self.sides) else self.point.gaussians

    def area(self, scale: float) -> float:
        """Points^2, of which a Gaussian has `scale`."""
        if any(self.sides):
            return ARROW
        return area(self.gaussians, scale) if self.gaussians else FIXED


@dataclass
class Panel:
    """Axes of matplotlib and what they show."""

    axes: Any
    trade_off: TradeOff
    cost: Measure
    quality: Measure
    unit: str  # of the cost
    x_axis: Axis
    y_axis: Axis
    lines: list[Line] = field(default_factory=list)  # that names should not hide

    @cached_property
    def marks(self) -> list[Mark]:
        """One for each point that has both numbers."""
        found = []
        for point in self.trade_off.points:
            x, y, role = point.value(self.cost), point.value(self.quality), self.trade_off.role(point.preset)
            if not x or y is None:  # a logarithmic axis has no place for 0
                continue
            at, sides = (self.x_axis.position(x), self.y_axis.position(y)), (self.x_axis.side(x), self.y_axis.side(y))
            found.append(Mark(point, role, x, y, at, sides))
        return found

    def draw(self, scale: float, tips: Tips) -> None:
        """All but the names. A Gaussian has `scale` points^2; `tips` takes what the marks say."""
        self.x_axis.dress(self.axes.xaxis)
        self.y_axis.dress(self.axes.yaxis)
        self._draw_front()
        self._draw_marks(scale, tips)

    def name(self, scale: float) -> list[Any]:
        """Write names at the marks, main methods first, once the layout is fixed; released programs have none beside
        their corrected twins. What stands at the margin says its numbers. The texts are those that found room.
        """
        wanted = []
        for mark in sorted(self.marks, key=lambda mark: mark.role != "main"):
            if mark.role == "release" and self._twin(mark) and not any(mark.sides):
                continue
            x_side, y_side = mark.sides
            values = [f"{mark.y:.1f} dB"] * bool(y_side) + [f"{brief(mark.x)} {self.unit}"] * bool(x_side)
            text = "\n".join([methods.short(mark.point.title, mark.point.preset), ", ".join(values)]).strip()
            radius = math.sqrt(mark.area(scale)) / 2
            wanted.append(Name(text, mark.at, radius, weight_of(mark.point.preset, mark.role)))
        marks = [(*mark.at, math.sqrt(mark.area(scale)) / 2) for mark in self.marks]
        return names.write(self.axes, wanted, marks, self.lines)

    def _draw_front(self) -> None:
        """The Pareto front of all that compete, without released programs, as far as the window goes."""
        rivals = [m for m in self.marks if m.role != "release" and m.point.preset not in self.trade_off.unranked]
        front = pareto([(mark.x, mark.y) for mark in rivals], higher_is_better=True)
        drawn = {(mark.x, mark.y): mark.at for mark in self.marks}
        corners = [drawn[point] for point in front]
        corners += [(max(self.x_axis.window[1], corners[-1][0]), corners[-1][1])] if corners else []
        steps = [corner for (_, y), (x, top) in pairwise(corners) for corner in ((x, y), (x, top))]
        self._line([*corners[:1], *steps], color=SOFT[0], linewidth=0.9, zorder=1.5)

    def _draw_marks(self, scale: float, tips: Tips) -> None:
        """All marks, with links between twins and a standard deviation to each side where there are several seeds."""
        presets = [point.preset for point in self.trade_off.points]
        for mark in self.marks:
            color = color_of(mark.point.preset, presets)
            if mark.role == "release" and (twin := self._twin(mark)):
                self._line([mark.at, twin.at], color=color, linewidth=0.7, alpha=0.35, zorder=1.4)
            for ends in self._spread(mark):
                self._line(ends, color=color, linewidth=0.8, alpha=0.6 * ALPHA[mark.role], zorder=2)
            numbers = [f"{name}: {brief(c.value, 4)}" for name, c in mark.point.numbers.items() if c.value is not None]
            tip = tips.add("\n".join([mark.point.title, *numbers]))
            self.axes.scatter(*mark.at, clip_on=False, gid=tip, s=mark.area(scale), **_look(mark, color))

    def _line(self, corners: Line, **look: Any) -> None:
        if corners:
            self.lines.append(corners)
            self.axes.plot(*zip(*corners, strict=True), **look)

    def _twin(self, mark: Mark) -> Mark | None:
        twin = self.trade_off.corrected(mark.point)
        return next((other for other in self.marks if other.point is twin), None)

    def _spread(self, mark: Mark) -> list[Line]:
        """A line along each axis in which a mark stands in its place and has several seeds."""
        x_std, y_std = (mark.point.numbers[measure.column.title].std for measure in (self.cost, self.quality))
        (x, y), (x_side, y_side) = mark.at, mark.sides
        along = [[(max(x - x_std, x / 10), y), (x + x_std, y)]] if x_std and not x_side else []
        return along + ([[(x, y - y_std), (x, y + y_std)]] if y_std and not y_side else [])


def area(gaussians: float, scale: float) -> float:
    """Points^2 of a mark for so many Gaussians, of which one has `scale`."""
    return max(scale * gaussians, SMALLEST)


def brief(value: float, digits: int = 3) -> str:
    """So many digits, or all of those before the point.

    >>> brief(24.8512), brief(123456.0)
    ('24.9', '123,456')
    """
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.{digits}g}"


def _look(mark: Mark, color: str) -> dict[str, Any]:
    look: dict[str, Any] = {"alpha": ALPHA[mark.role], "zorder": 3 if mark.role == "main" else 2.5}
    if any(mark.sides):  # an arrow head that points to where the mark is
        look["marker"] = (3, 0, math.degrees(math.atan2(mark.sides[1], mark.sides[0])) - 90)
    elif mark.role != "release" and not mark.gaussians:
        look["marker"] = "D"
    if mark.role == "release":
        return look | {"facecolors": "none", "edgecolors": color, "linewidths": 1.0}
    ours = weight_of(mark.point.preset, mark.role) == "bold"
    return look | {"facecolors": color, "edgecolors": INK[0] if ours else PAPER[0], "linewidths": 1.2 if ours else 0.5}
