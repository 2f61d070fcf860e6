from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import stdtrit
from scipy.stats import ttest_ind_from_stats

from padgs.reports.significance import BEST, CONFIDENCE, SECOND, better_rows, emphasis, places, pooled_variance
from padgs.reports.table import Block, Cell, Column, Row, format_number

PSNR, LPIPS, COUNT = Column("PSNR", 2, True), Column("LPIPS", 3, False), Column("Gaussians", 0)


def ranks(column: Column, *cells: Cell) -> dict[int, str]:
    block = Block("", tuple(Row(str(i), (cell,)) for i, cell in enumerate(cells)))
    return emphasis(block, 0, (column,))


FIRST, NEAR, FAR = Cell(25.0, 0.1, 3), Cell(25.1, 0.1, 3), Cell(24.0, 0.1, 3)


@pytest.mark.parametrize(
    ("column", "cells", "expected"),
    [
        (PSNR, (Cell(1.0), Cell(3.0), Cell(2.0)), {1: BEST, 2: SECOND}),
        (LPIPS, (Cell(1.0), Cell(3.0), Cell(2.0)), {0: BEST, 2: SECOND}),
        (COUNT, (Cell(1.0), Cell(3.0), Cell(2.0)), {}),
        (PSNR, (Cell(1.0), Cell(status="oom")), {}),
        (PSNR, (Cell(1.001), Cell(1.0), Cell(0.5)), {0: BEST, 1: BEST, 2: SECOND}),  # print alike
        (PSNR, (Cell(1.001), Cell(1.0)), {}),
        (PSNR, (FIRST, NEAR, FAR), {0: BEST, 1: BEST, 2: SECOND}),
        (PSNR, (FAR, FIRST, NEAR, Cell(20.0)), {1: BEST, 2: BEST, 0: SECOND}),
        (PSNR, (FIRST, NEAR), {}),
        (PSNR, (Cell(float("inf")), Cell(1.0)), {0: BEST, 1: SECOND}),
        (PSNR, (Cell(float("-inf")), Cell(1.0)), {1: BEST, 0: SECOND}),
    ],
)
def test_best_and_second(column, cells, expected):
    assert ranks(column, *cells) == expected


def test_means_are_tested_as_they_are_and_not_as_they_print():
    for far, expected in ((0.99, set()), (1.01, {1})):
        cells = {0: Cell(25.0, 0.4, 4), 1: Cell(25.0 + far * stdtrit(6, 0.975) * 0.4 / 2**0.5, 0.4, 4)}
        assert better_rows(cells, Column("", 0, True))[0] == expected


@given(
    st.lists(st.tuples(st.floats(20, 30), st.floats(0.01, 1), st.integers(1, 4)), min_size=2, max_size=6),
    st.sampled_from([PSNR, LPIPS]),
)
def test_rows_share_a_place_exactly_as_long_as_no_test_separates_them(numbers, column):
    cells = {i: Cell(mean, std if count > 1 else None, count) for i, (mean, std, count) in enumerate(numbers)}
    shared, better = places(cells, column), better_rows(cells, column)
    assert sorted(i for place in shared for i in place) == list(cells)
    means = [cells[i].value for place in shared for i in place]
    assert means == sorted(means, reverse=column.higher_is_better), "none stands above a better mean"
    assert all(better[i].isdisjoint(place) for place in shared for i in place)
    assert all(better[below[0]] & set(above) for above, below in pairwise(shared))
    for i, j in ((i, j) for i in cells for j in cells if cells[i].count > 1 and cells[j].count > 1):
        first, second = cells[i], cells[j]
        test = ttest_ind_from_stats(
            first.value, first.std, first.count, second.value, second.std, second.count, equal_var=False
        )
        differ = format_number(first.value, column) != format_number(second.value, column)
        assert (i in better[j] or j in better[i]) == (differ and test.pvalue < 1 - CONFIDENCE)


def test_single_runs_scatter_as_the_seeds_of_the_other_rows():
    pooled = Cell(20.0, 0.1, 3), Cell(21.0, 0.3, 2)
    variance, freedom = pooled_variance(pooled)
    assert (variance, freedom) == (pytest.approx((2 * 0.01 + 0.09) / 3), 3)
    apart = stdtrit(freedom, 0.975) * (2 * variance) ** 0.5  # one estimate for both, with its degrees of freedom
    for far, expected in ((0.95 * apart, set()), (1.05 * apart, {1})):
        cells = dict(enumerate((Cell(25.0), Cell(25.0 + far), *pooled)))
        assert better_rows(cells, Column("", 6, True))[0] == expected
    for others in ((), (Cell(20.0, 3.0, 2),)):
        cells = dict(enumerate((Cell(25.0), Cell(25.01), *others)))
        assert 1 in better_rows(cells, PSNR)[0], "with one pair of seeds or none the number decides"


def test_what_is_not_ranked_neither_stands_out_nor_stands_in_the_way():
    aside = Cell(9.0, ranked=False)
    assert ranks(PSNR, Cell(1.0), aside, Cell(2.0)) == {2: BEST, 0: SECOND}
    assert Row("A", (Cell(1.0), aside)).texts((PSNR, PSNR)) == ["A †", "1.00", "9.00"]
