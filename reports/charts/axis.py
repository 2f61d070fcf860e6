"""The limits of an axis, which show where methods differ, and its scale and ticks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

FENCE = 1.5  # interquartile ranges
PAD = 0.1  # share of the shown range that is free at both ends
SINGLE = {False: 1.0, True: 0.5}  # range around a single value: one unit, or half a decade of a logarithmic axis


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


def set_axis(axis: Any, values: Sequence[float], logarithmic: bool = False, worse: int = 0) -> tuple[float, float]:
    """Set limits, scale and ticks of a matplotlib axis for values, all positive if logarithmic; return the limits.

    `worse`: see `window`.
    """
    from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator, NullLocator

    scaled = [math.log10(value) if logarithmic else value for value in values or [1.0]]
    low, high = window(scaled, worse)
    if high == low:
        low, high = low - SINGLE[logarithmic] / 2, high + SINGLE[logarithmic] / 2
    pad = PAD * (high - low)
    ends = (10 ** (low - pad), 10 ** (high + pad)) if logarithmic else (low - pad, high + pad)
    panel, name = axis.axes, axis.axis_name
    getattr(panel, f"set_{name}scale")("log" if logarithmic else "linear")
    getattr(panel, f"set_{name}lim")(ends)
    few = logarithmic and ends[1] < 3 * ends[0]
    axis.set_major_locator(
        LogLocator(subs=(1.0, 2.0, 5.0)) if logarithmic and not few else MaxNLocator(6, steps=[1, 2, 5, 10])
    )
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(EngFormatter(sep="") if ends[1] >= 1e4 else "{x:g}")
    return ends
