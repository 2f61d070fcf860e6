import numpy as np
import pytest
from support.made_up import assert_apart

from padgs.reports.charts.drawing import figure, lay_out
from padgs.reports.charts.labels import BESIDE, Label, write_labels

RADIUS = 5.0  # points


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
