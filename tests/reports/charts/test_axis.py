import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from padgs.reports.charts.axis import Axis, window

values = st.lists(st.floats(0.01, 1e4), min_size=1, max_size=20)


@given(values, st.sampled_from([-1, 0, 1]))
def test_a_window_excludes_few_values_and_only_at_the_worse_end(known, worse):
    low, high = window(known, worse)
    first, third = np.quantile(known, [0.25, 0.75])
    assert low in known and high in known
    out = {-1: sum(v < low for v in known), 1: sum(v > high for v in known)}
    assert max(out.values()) <= len(known) / 4 and all(count == 0 for end, count in out.items() if end != worse)
    if worse:
        far = first - low if worse < 0 else high - third
        assert far <= 1.5 * (third - first) + 1e-9


def test_the_best_value_and_one_of_two_are_never_outliers():
    assert window([19.8, 27.4, 27.8, 29.0, 30.0, 31.5], 1) == (19.8, 31.5)
    assert window([20.0, 30.0], -1) == (20.0, 30.0)


@given(values, st.booleans(), st.sampled_from([-1, 1]))
def test_every_mark_is_inside_the_limits_and_outliers_are_outside_the_window(known, logarithmic, worse):
    axis = Axis.of(known, logarithmic, worse)
    (low, high), (bottom, top) = axis.window, axis.limits
    for value in known:
        position = axis.position(value)
        assert bottom < position < top
        assert (position == value) if low <= value <= high else (position < low) == (value < low)
        assert axis.side(value) == (position > high) - (position < low)


@pytest.mark.parametrize("logarithmic", [False, True])
@pytest.mark.parametrize("known", [[50.0, 190.0], [9.5, 15.0, 20.0], [40.0, 21e3], [28.1, 28.4], [7.0]])
def test_an_axis_has_ticks_in_its_window(known, logarithmic):
    axis = Axis.of(known, logarithmic)
    ticks = axis.ticks()
    assert len(ticks) >= 2 and all(axis.window[0] <= tick <= axis.window[1] for tick in ticks)
