import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from padgs.reports.charts.axis import Axis, window

values = st.lists(st.floats(0.01, 1e4), min_size=1, max_size=20)


@given(values, st.sampled_from([-1, 0, 1]))
def test_a_window_leaves_few_out_and_only_at_the_worse_end(known, worse):
    low, high = window(known, worse)
    first, third = np.quantile(known, [0.25, 0.75])
    assert low in known and high in known
    out = {-1: sum(v < low for v in known), 1: sum(v > high for v in known)}
    assert max(out.values()) <= len(known) / 4 and all(count == 0 for end, count in out.items() if end != worse)
    if worse:
        far = first - low if worse < 0 else high - third
        assert far <= 1.5 * (third - first) + 1e-9


def test_one_far_below_does_not_squeeze_the_others():
    assert window([19.8, 27.4, 27.8, 29.0, 30.0, 31.5], -1) == (27.4, 31.5)
    assert window([19.8, 27.4, 27.8, 29.0, 30.0, 31.5], 1) == (19.8, 31.5), "the best is never left out"
    assert window([20.0, 30.0], -1) == (20.0, 30.0), "two methods are two methods"


@given(values, st.booleans(), st.sampled_from([-1, 1]))
def test_every_value_has_a_place_inside_the_limits_and_strays_have_theirs_outside_the_window(known, logarithmic, worse):
    axis = Axis.of(known, logarithmic, worse)
    (low, high), (bottom, top) = axis.window, axis.limits
    for value in known:
        place = axis.position(value)
        assert bottom < place < top
        assert (place == value) if low <= value <= high else (place < low) == (value < low)
        assert axis.side(value) == (place > high) - (place < low)


@pytest.mark.parametrize("known", [[50.0, 190.0], [9.5, 15.0, 20.0], [40.0, 21e3], [28.1, 28.4], [7.0]])
def test_an_axis_has_round_ticks_in_its_window(known):
    for axis in (Axis.of(known), Axis.of(known, logarithmic=True)):
        ticks = axis.ticks()
        assert len(ticks) >= 2 and all(axis.window[0] <= tick <= axis.window[1] for tick in ticks)
