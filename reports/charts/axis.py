"""An axis that shows where methods differ, with a margin for those beyond."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from padgs.reports.charts.palette import BEYOND

FENCE = 1.5  # interquartile ranges
PAD, MARGIN = 0.1, 0.14  # of the window: free on both sides; and beyond that, where something lies outside
ALONE = {False: 1.0, True: 0.5}  # the window of a single value: one unit; half a decade of a logarithmic axis
TICKS = 3  # at least
ROUND = ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0))  # leading digits, sparse to dense


def window(values: Sequence[float], worse: int) -> tuple[float, float]:
    """The smallest and the largest value that an axis shows in its place; what lies beyond stands at the margin.

    The rule is that of box plots (Tukey, Exploratory Data Analysis, 1977) at the worse end of the axis (-1 its low, 1
    its high one, 0 neither): a value is left out if it lies more than 1.5 interquartile ranges beyond the quartile
    there. So no method squeezes the others by how bad it is, no more than a quarter of the values is left out, and
    none for being good. On a logarithmic axis, give logarithms.

    >>> window([19.8, 27.4, 27.8, 29.0, 30.0, 31.5], worse=-1), window([20.0, 30.0], worse=-1)
    ((27.4, 31.5), (20.0, 30.0))
    """
    first, third = np.quantile(values, [0.25, 0.75])
    reach = FENCE * (third - first)
    low, high = (first - reach if worse < 0 else -math.inf), (third + reach if worse > 0 else math.inf)
    kept = [value for value in values if low <= value <= high]
    return min(kept), max(kept)


@dataclass(frozen=True)
class Axis:
    """The window of an axis and its limits, both in data units."""

    window: tuple[float, float]
    limits: tuple[float, float]
    logarithmic: bool

    @classmethod
    def of(cls, values: Sequence[float], logarithmic: bool = False, worse: int = 0) -> Axis:
        """The axis for some values, all positive if it is logarithmic; `worse` as for `window`."""
        values = values or [1.0]
        scaled = [math.log10(value) if logarithmic else value for value in values]
        low, high = window(scaled, worse)
        if high == low:
            low, high = low - ALONE[logarithmic] / 2, high + ALONE[logarithmic] / 2
        size = high - low
        bottom = low - size * (PAD + MARGIN * (min(scaled) < low))
        top = high + size * (PAD + MARGIN * (max(scaled) > high))
        pad = PAD * size

        def data(value: float) -> float:
            return 10**value if logarithmic else value

        return cls((data(low - pad), data(high + pad)), (data(bottom), data(top)), logarithmic)

    def side(self, value: float) -> int:
        """Beyond which end of the window a value lies: -1 below, 1 above, 0 for neither."""
        return (value > self.window[1]) - (value < self.window[0])

    def position(self, value: float) -> float:
        """Where a value is drawn: at its place, or in the middle of the margin that it lies beyond."""
        side = self.side(value)
        if not side:
            return value
        inner, outer = (self.window[side > 0], self.limits[side > 0])
        return math.sqrt(inner * outer) if self.logarithmic else (inner + outer) / 2

    def dress(self, drawn: Any) -> None:
        """Scale, limits and ticks of an axis of matplotlib, and a ground behind its margins."""
        from matplotlib.ticker import EngFormatter, FixedLocator, NullLocator

        panel, name = drawn.axes, drawn.axis_name
        getattr(panel, f"set_{name}scale")("log" if self.logarithmic else "linear")
        getattr(panel, f"set_{name}lim")(self.limits)
        ticks = self.ticks()
        drawn.set_major_locator(FixedLocator(ticks))
        drawn.set_minor_locator(NullLocator())
        drawn.set_major_formatter(EngFormatter(sep="") if ticks[-1] >= 1e4 else "{x:g}")
        for inner, outer in zip(self.window, self.limits, strict=True):
            if inner != outer:
                getattr(panel, f"ax{'v' if name == 'x' else 'h'}span")(inner, outer, color=BEYOND[0], lw=0, zorder=0.6)

    def ticks(self) -> list[float]:
        """Round numbers within the window."""
        from matplotlib.ticker import LogLocator, MaxNLocator

        low, high = self.window
        for digits in ROUND if self.logarithmic else ():
            found = [float(tick) for tick in LogLocator(subs=digits).tick_values(low, high) if low <= tick <= high]
            if len(found) >= TICKS:
                return found
        locator = MaxNLocator(6, steps=[1, 2, 5, 10])
        return [float(tick) for tick in locator.tick_values(low, high) if low <= tick <= high]
