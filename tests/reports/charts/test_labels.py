import numpy as np
import pytest

from padgs.reports.charts.labels import Named, place

INSIDE = (50.0, 40.0, 500.0, 360.0)


def boxes(named, middles) -> np.ndarray:
    """Left, bottom, right, top of each name."""
    middles, sizes = np.array(middles), np.array([one.size for one in named])
    return np.concatenate([middles - sizes / 2, middles + sizes / 2], 1)


def touching(found: np.ndarray) -> list[tuple[int, int]]:
    return [
        (i, j)
        for i in range(len(found))
        for j in range(i)
        if (np.maximum(found[i, :2], found[j, :2]) < np.minimum(found[i, 2:], found[j, 2:])).all()
    ]


@pytest.mark.parametrize("seed", range(3))
def test_twenty_names_of_marks_in_a_heap_touch_neither_each_other_nor_the_edge(seed):
    rng = np.random.default_rng(seed)
    at = rng.normal((275, 200), (90, 60), (20, 2)).clip(INSIDE[:2], INSIDE[2:])
    named = [Named((x, y), 7.0, (width, 12.0)) for (x, y), width in zip(at, rng.uniform(30, 110, 20), strict=True)]
    marks = [(*one.at, one.radius) for one in named]
    middles = place(named, INSIDE, marks)
    assert None not in middles and middles == place(named, INSIDE, marks), "all have room, and the same each time"
    found = boxes(named, middles)
    assert touching(found) == []
    assert (found[:, :2] >= INSIDE[:2]).all() and (found[:, 2:] <= INSIDE[2:]).all()


def test_a_name_stands_beside_its_mark_and_makes_way_for_other_marks_and_lines():
    one = Named((200.0, 200.0), 7.0, (60.0, 12.0))
    (alone,) = place([one], INSIDE, [(200, 200, 7)])
    (shy,) = place([one], INSIDE, [(200, 200, 7), (*alone, 9)])
    (free,) = place([one], INSIDE, [(200, 200, 7)], [(x, alone[1]) for x in range(200, 260, 5)])
    for middle in (alone, shy, free):
        gap = np.linalg.norm(np.clip((0, 0), *(np.subtract(middle, one.at) + [[-30, -6], [30, 6]]))) - 7
        assert 0 <= gap < 8
    left, bottom, right, top = boxes([one], [shy])[0]
    assert not (left < alone[0] < right and bottom < alone[1] < top)
    assert abs(free[1] - alone[1]) > 6


def test_where_there_is_no_room_the_first_has_its_name():
    named = [Named((20.0, 20.0), 3.0, (30.0, 12.0))] * 3
    found = place(named, (0.0, 0.0, 45.0, 40.0), [(20, 20, 3)])
    assert found[0] is not None and found[2] is None
