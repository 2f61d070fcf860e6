import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from padgs.reports.charts.axis import set_axis, window
from padgs.reports.charts.drawing import figure

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


@pytest.mark.parametrize("logarithmic", [False, True])
@pytest.mark.parametrize("known", [[50.0, 190.0], [9.5, 15.0, 20.0], [40.0, 21e3], [28.1, 28.4], [7.0]])
def test_an_axis_contains_its_values_and_has_ticks(known, logarithmic):
    made, axes = figure(1, 1)
    low, high = set_axis(axes[0, 0].yaxis, known, logarithmic)
    made.draw_without_rendering()
    assert all(low < value < high for value in known)
    assert sum(low <= tick <= high for tick in axes[0, 0].get_yticks()) >= 2
