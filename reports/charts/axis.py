"""An axis that shows where methods differ, with a margin for values beyond it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from padgs.reports.charts.drawing import MARGIN_COLOR

FENCE = 1.5  # interquartile ranges
PAD, MARGIN = 0.1, 0.14  # shares of the window: free at both ends, and for values beyond an end
SINGLE = {False: 1.0, True: 0.5}  # window of a single value: one unit, or half a decade of a logarithmic axis
TICKS = 3  # minimum
DIGITS = ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0))  # leading digits of ticks


def window(values: Sequence[float], worse: int) -> tuple[float, float]:
    """Return the smallest and largest value that is no outlier at the worse end (-1 low, 1 high, 0 neither).

    An outlier lies more than 1.5 interquartile ranges beyond the quartile (Tukey, Exploratory Data Analysis, 1977).
    At most a quarter of the values are outliers, and the best value never is. Pass logarithms for logarithmic axes.

    >>> window([19.8, 27.4, 27.8, 29.0, 30.0, 31.5], worse=-1), window([20.0, 30.0], worse=-1)
    ((27.4, 31.5), (20.0, 30.0))
    """
    first, third = np.quantile(values, [0.25, 0.75])
    reach = FENCE * (third - first)
    low, high = (first - reach if worse < 0 else -math.inf), (third + reach if worse > 0 else math.inf)
    kept = [value for value in values if low <= value <= high]
    return min(kept), max(kept)


def spans(values: Sequence[float], ratio: float) -> bool:
    """Return whether all values are positive and the largest is at least `ratio` times the smallest."""
    return bool(values) and min(values) > 0 and max(values) / min(values) >= ratio


@dataclass(frozen=True)
class Axis:
    """The window of an axis and its limits, which add padding and margins, both in data units."""

    window: tuple[float, float]
    limits: tuple[float, float]
    logarithmic: bool

    @classmethod
    def of(cls, values: Sequence[float], logarithmic: bool = False, worse: int = 0) -> Axis:
        """Return the axis for values, all positive if it is logarithmic; `worse` as for `window`."""
        values = values or [1.0]
        scaled = [math.log10(value) if logarithmic else value for value in values]
        low, high = window(scaled, worse)
        if high == low:
            low, high = low - SINGLE[logarithmic] / 2, high + SINGLE[logarithmic] / 2
        size = high - low
        bottom = low - size * (PAD + MARGIN * (min(scaled) < low))
        top = high + size * (PAD + MARGIN * (max(scaled) > high))
        ends = (low - PAD * size, high + PAD * size, bottom, top)
        low, high, bottom, top = (10**end for end in ends) if logarithmic else ends
        return cls((low, high), (bottom, top), logarithmic)

    def side(self, value: float) -> int:
        """Return the end of the window that a value lies beyond: -1 below, 1 above, 0 neither."""
        return (value > self.window[1]) - (value < self.window[0])

    def position(self, value: float) -> float:
        """Return the position of a value's mark: the value, or the middle of the margin that it lies beyond."""
        side = self.side(value)
        if not side:
            return value
        inner, outer = self.window[side > 0], self.limits[side > 0]
        return math.sqrt(inner * outer) if self.logarithmic else (inner + outer) / 2

    def apply(self, axis: Any) -> None:
        """Set scale, limits and ticks of a matplotlib axis, and shade its margins."""
        from matplotlib.ticker import EngFormatter, FixedLocator, NullLocator

        panel, name = axis.axes, axis.axis_name
        getattr(panel, f"set_{name}scale")("log" if self.logarithmic else "linear")
        getattr(panel, f"set_{name}lim")(self.limits)
        ticks = self.ticks()
        axis.set_major_locator(FixedLocator(ticks))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(EngFormatter(sep="") if ticks[-1] >= 1e4 else "{x:g}")
        for inner, outer in zip(self.window, self.limits, strict=True):
            if inner != outer:
                shade = panel.axvspan if name == "x" else panel.axhspan
                shade(inner, outer, color=MARGIN_COLOR[0], lw=0, zorder=0.6)

    def ticks(self) -> list[float]:
        """Return round numbers in the window."""
        from matplotlib.ticker import LogLocator, MaxNLocator

        low, high = self.window
        for digits in DIGITS if self.logarithmic else ():
            found = [float(tick) for tick in LogLocator(subs=digits).tick_values(low, high) if low <= tick <= high]
            if len(found) >= TICKS:
                return found
        locator = MaxNLocator(6, steps=[1, 2, 5, 10])
        return [float(tick) for tick in locator.tick_values(low, high) if low <= tick <= high]
