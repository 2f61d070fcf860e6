import pytest

from reports.tables.ranking import BEST, SECOND, emphasis, within_noise
from reports.tables.table import Block, Cell, Column, Row

PSNR, LPIPS, COUNT = Column("PSNR", 2, True), Column("LPIPS", 3, False), Column("Gaussians", 0)


def ranks(column: Column, *cells: Cell) -> dict[int, str]:
    block = Block("", tuple(Row(str(i), (cell,)) for i, cell in enumerate(cells)))
    return emphasis(block, 0, (column,))


def test_each_metric_has_its_own_direction():
    cells = Cell(1.0), Cell(3.0), Cell(2.0)
    assert ranks(PSNR, *cells) == {1: BEST, 2: SECOND}
    assert ranks(LPIPS, *cells) == {0: BEST, 2: SECOND}
    assert ranks(COUNT, *cells) == {}


def test_nothing_stands_out_alone_and_failures_do_not_compete():
    assert ranks(PSNR, Cell(1.0), Cell(status="oom")) == {}


def test_what_prints_the_same_shares_a_place():
    assert ranks(PSNR, Cell(1.001), Cell(1.0), Cell(0.5)) == {0: BEST, 1: BEST, 2: SECOND}


def test_nothing_stands_out_among_equals():
    assert ranks(PSNR, Cell(1.001), Cell(1.0)) == {}


def test_a_tie_inside_the_noise_has_no_winner():
    #           the standard error of the difference of two means over 4 seeds is 0.1 sqrt(2 / 4) = 0.07
    assert ranks(PSNR, Cell(25.0, 0.1, 4), Cell(25.13, 0.1, 4)) == {}
    assert ranks(PSNR, Cell(25.0, 0.1, 4), Cell(25.15, 0.1, 4)) == {1: BEST, 0: SECOND}


def test_a_clear_winner_stands_above_a_tie_for_the_second_place():
    assert ranks(PSNR, Cell(27.0, 0.1, 4), Cell(25.0, 0.1, 4), Cell(25.1, 0.1, 4)) == {0: BEST}


def test_a_single_run_scatters_as_the_seeds_beside_it():
    assert within_noise(Cell(25.0, 0.1, 4), Cell(25.2))  # sqrt(0.01 / 4 + 0.01) = 0.11
    assert not within_noise(Cell(25.0, 0.1, 4), Cell(25.25))
    assert not within_noise(Cell(25.0), Cell(25.0001))


def test_what_is_not_ranked_neither_stands_out_nor_stands_in_the_way():
    aside = Cell(9.0, ranked=False)
    assert ranks(PSNR, Cell(1.0), aside, Cell(2.0)) == {2: BEST, 0: SECOND}
    assert Row("A", (Cell(1.0), aside)).texts((PSNR, PSNR)) == ["A †", "1.00", "9.00"]


@pytest.mark.parametrize("value", [float("inf"), float("-inf")])
def test_infinities_are_ranked(value):
    assert ranks(PSNR, Cell(value), Cell(1.0))[0 if value > 0 else 1] == BEST
