import math
from itertools import pairwise

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.special import stdtrit
from scipy.stats import ttest_ind_from_stats, ttest_rel

from padgs.reports.significance import BEST, SECOND, differ, emphasis, paired_test, places
from padgs.reports.table import Block, Cell, Column, Row

PSNR, LPIPS, COUNT = Column("PSNR", 2, True), Column("LPIPS", 3, False), Column("Gaussians", 0)


def ranks(column: Column, *cells: Cell) -> dict[int, str]:
    block = Block("", tuple(Row(str(i), (cell,)) for i, cell in enumerate(cells)))
    return emphasis(block, 0, (column,))


def seeds(value: float, std: float = 0.1, count: int = 3) -> Cell:
    return Cell(value, std, count)


ONE, TWO, THREE = seeds(10.0), seeds(20.0), seeds(30.0)


@pytest.mark.parametrize(
    ("column", "cells", "expected"),
    [
        (PSNR, (ONE, THREE, TWO), {1: BEST, 2: SECOND}),
        (LPIPS, (ONE, THREE, TWO), {0: BEST, 2: SECOND}),
        (COUNT, (ONE, THREE, TWO), {}),
        (PSNR, (ONE, Cell(status="oom")), {}),
        (PSNR, (seeds(10.001), seeds(10.0), seeds(5.0)), {0: BEST, 1: BEST, 2: SECOND}),  # print alike
        (PSNR, (seeds(25.0), seeds(25.1), seeds(24.0)), {0: BEST, 1: BEST, 2: SECOND}),
        (PSNR, (seeds(25.0), seeds(25.1)), {}),
        (PSNR, (seeds(27.0, 2.0), seeds(25.0, 2.0), seeds(10.0)), {}),  # never two best rows 2 dB apart
        (PSNR, (THREE, seeds(22.0, 2.0), seeds(20.0, 2.0)), {0: BEST}),  # nor two second ones
        (PSNR, (Cell(20.0), Cell(30.0)), {}),
        (PSNR, (seeds(20.0, count=2), seeds(30.0, count=2)), {}),
        (PSNR, (Cell(29.9), THREE, TWO), {1: BEST}),  # a single run could be second
        (PSNR, (Cell(30.1), THREE, TWO), {}),  # or best
        (PSNR, (Cell(5.0), THREE, TWO), {1: BEST, 2: SECOND}),
        (PSNR, (Cell(math.inf, None, 3), TWO), {0: BEST, 1: SECOND}),
    ],
)
def test_best_and_second(column, cells, expected):
    assert ranks(column, *cells) == expected


@given(st.lists(st.floats(-9, 9), min_size=2, max_size=6), *(st.floats(0.01, 3) for _ in range(2)), st.integers(3, 9))
def test_tests_agree_with_scipy(differences, one, other, count):
    cells = Cell(25.0, one, count), Cell(26.0, other, 4)
    expected = ttest_ind_from_stats(*(25.0, one, count), *(26.0, other, 4), equal_var=False).pvalue < 0.05
    assert differ(*cells, PSNR) == expected
    assume(max(differences) - min(differences) > 1e-6)
    found = ttest_rel(differences, [0.0] * len(differences))
    p, *interval = paired_test(differences)
    assert p == pytest.approx(found.pvalue, rel=1e-6) and interval == pytest.approx([*found.confidence_interval(0.95)])


def test_equal_differences_are_certain_unless_they_are_zero():
    assert paired_test([1.0, 1.0]) == (0.0, 1.0, 1.0) and paired_test([0.0, 0.0])[0] == 1.0


def test_means_are_tested_as_they_are_and_not_as_they_print():
    for far, expected in ((0.99, False), (1.01, True)):
        other = Cell(25.0 + far * stdtrit(6, 0.975) * 0.4 / 2**0.5, 0.4, 4)
        assert differ(Cell(25.0, 0.4, 4), other, Column("", 0, True)) == expected


@given(
    st.lists(st.tuples(st.floats(20, 30), st.floats(0.01, 1), st.integers(3, 5)), min_size=2, max_size=6),
    st.sampled_from([PSNR, LPIPS]),
)
def test_rows_share_a_place_exactly_as_long_as_no_test_separates_them(numbers, column):
    cells = {i: Cell(*number) for i, number in enumerate(numbers)}
    shared = places(cells, column)
    assert sorted(i for place in shared for i in place) == list(cells)
    means = [cells[i].value for place in shared for i in place]
    assert means == sorted(means, reverse=column.higher_is_better), "none stands above a better mean"
    assert not any(differ(cells[i], cells[j], column) for place in shared for i in place for j in place)
    assert all(any(differ(cells[i], cells[below[0]], column) for i in above) for above, below in pairwise(shared))


def test_what_is_not_ranked_neither_stands_out_nor_stands_in_the_way():
    aside = Cell(9.0, ranked=False)
    assert ranks(PSNR, ONE, aside, TWO) == {2: BEST, 0: SECOND}
    assert Row("A", (aside, Cell())).texts((PSNR, PSNR)) == ["A †", "9.00", "–"]
    assert Row("A", (Cell(1.0), aside)).texts((PSNR, PSNR)) == ["A", "1.00", "9.00 †"]


def test_what_failed_on_a_seed_is_not_marked_and_stands_in_the_way_where_it_would_be_best():
    failing = Cell(40.0, 0.1, 3, "oom")
    assert ranks(PSNR, ONE, TWO, failing) == {}
    assert ranks(PSNR, Cell(5.0, 0.1, 3, "oom"), ONE, TWO) == {2: BEST, 1: SECOND}
