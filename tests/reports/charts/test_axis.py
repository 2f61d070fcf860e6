import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reports.charts.axis import Axis, window

values = st.lists(st.floats(0.01, 1e4), min_size=1, max_size=20)


@given(values)
def test_a_window_gives_the_middle_half_room_and_leaves_few_out(known):
    low, high = window(known)
    first, third = np.quantile(known, [0.25, 0.75])
    assert low in known and high in known
    assert sum(v < low for v in known) <= len(known) / 4 and sum(v > high for v in known) <= len(known) / 4
    assert high - low <= 4 * (third - first) + 1e-9
    whole = Axis.of(known, whole=True)
    assert {whole.side(value) for value in known} == {0}


def test_one_far_below_does_not_squeeze_the_others():
    assert window([19.8, 27.4, 27.8, 29.0, 30.0, 31.5]) == (27.4, 31.5)
    assert window([20.0, 30.0]) == (20.0, 30.0), "two methods are two methods"


@given(values, st.booleans())
def test_every_value_has_a_place_inside_the_limits_and_strays_have_theirs_outside_the_window(known, logarithmic):
    axis = Axis.of(known, logarithmic)
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
