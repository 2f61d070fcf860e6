import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.made_up import assert_apart, compared, run_set, small, swept

from padgs import baselines
from padgs.reports.charts import sweep_chart, trade_off_chart
from padgs.reports.charts.drawing import (
    BESIDE,
    COLORS,
    Label,
    color_of,
    figure,
    lay_out,
    set_axis,
    window,
    write_labels,
)
from padgs.reports.methods import METHODS, method_of

RADIUS = 5.0  # points
values = st.lists(st.floats(0.01, 1e4), min_size=1, max_size=20)


def test_every_method_has_its_own_colour(root):
    presets = {*baselines.BUILT_IN, *(path.stem for path in (root / "conf" / "method").glob("*.yaml"))}
    assert {method_of(preset) for preset in presets} <= METHODS.keys(), "give new methods a line in methods.yaml"
    assert len(set(COLORS)) == len(COLORS)


def test_the_colour_of_a_method_does_not_depend_on_others():
    assert color_of("padgs_ray", ["omnigs", "padgs_ray"]) == color_of("padgs", []) != color_of("padgs_plus", [])
    assert color_of("yours", ["mine", "yours"]) != color_of("mine", ["mine", "yours"]) != color_of("padgs", [])


def test_charts_of_one_program_share_no_ids():
    runs = [*compared(["synthetic-room"], seeds=1)[3:], small(24.0, method="mine", experiments=("all_methods",))]
    runs += swept(values=(0.5, 0.9, 1.0), scenes=["synthetic-room"], seeds=2)
    svgs = [chart.svg for of in (trade_off_chart, sweep_chart) for chart in of.charts(run_set(runs))]
    ids = [set(re.findall(r' id="([a-z]+[0-9a-f]{10})"', svg)) for svg in svgs]
    assert len(ids) == 2 and min(map(len, ids)) > 0
    assert sum(map(len, ids)) == len(set().union(*ids))


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


def test_a_logarithmic_axis_of_less_than_a_decade_has_enough_ticks():
    made, axes = figure(1, 1)
    low, high = set_axis(axes[0, 0].xaxis, [27.7, 94.4], logarithmic=True)
    made.draw_without_rendering()
    assert [tick for tick in axes[0, 0].get_xticks() if low <= tick <= high] == pytest.approx([30, 50, 70, 100])


def test_no_value_lies_on_the_edge_of_an_axis():
    made, axes = figure(1, 1)
    known = [18.9, 22.4, 27.1, 31.3, 33.2, 40.8, 46.8, 97.0, 111.4]
    low, high = set_axis(axes[0, 0].xaxis, known, logarithmic=True, worse=1)
    assert not any(value < high < 1.03 * value or low < value < 1.03 * low for value in known)


@pytest.fixture
def panel():
    made, axes = figure(1, 1, 5.0, 4.0)
    axes[0, 0].set(xlim=(0, 1), ylim=(0, 1))
    lay_out(made, "title")
    return axes[0, 0]


def write(panel, positions, texts, marks=()):
    labels = [Label(text, at, RADIUS, "normal") for at, text in zip(positions, texts, strict=True)]
    return write_labels(panel, labels, [(*at, RADIUS) for at in (*positions, *marks)])


@pytest.mark.parametrize("seed", range(3))
def test_labels_of_a_crowd_touch_neither_each_other_nor_the_edge(panel, seed):
    rng = np.random.default_rng(seed)
    positions = [tuple(at) for at in rng.normal(0.5, 0.2, (20, 2)).clip(0, 1)]
    texts = write(panel, positions, [f"method{'x' * n}" for n in rng.integers(1, 9, 20)])
    assert len(texts) == 20
    assert_apart(panel, texts)


def test_a_label_stands_beside_its_mark_off_other_marks(panel):
    def extent(marks=()):
        (text,) = write(panel, [(0.5, 0.5)], ["PaD-GS"], marks)
        return text.get_window_extent()

    free = extent()
    occupied = tuple(panel.transData.inverted().transform(((free.x0 + free.x1) / 2, (free.y0 + free.y1) / 2)))
    at = panel.transData.transform((0.5, 0.5))
    for box in (free, beside := extent([occupied])):
        nearest = np.clip(at, box.min, box.max)
        assert 0 <= np.linalg.norm(nearest - at) - RADIUS * panel.figure.dpi / 72 <= BESIDE
    assert not beside.contains(*panel.transData.transform(occupied))


def test_a_label_without_room_is_left_out(panel):
    written = write(panel, [(0.5, 0.5)] * 2, ["wider than the axes " * 10, "short"])
    assert [text.get_text() for text in written] == ["short"]
