"""Which numbers of a column stand out: the best and the second, by the column's own direction and beyond the noise."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

from padgs.reports.tables.table import Block, Cell, Column, shown

BEST, SECOND = "best", "second"
CONFIDENCE = 0.95
NOTE = (
    "Bold: best; underlined: second; rows that seeds cannot separate share a place (Welch's t-test, two-sided, "
    f"{CONFIDENCE:.0%}; a single run is taken to scatter as the seeds of the other rows; where these are no more than "
    "one pair, single runs tie with their equals only)."
)


def emphasis(block: Block, index: int, columns: tuple[Column, ...]) -> dict[int, str]:
    """Row -> BEST or SECOND for the column `index` of a block.

    Cells that are not `ranked` are left out. Nothing stands out where no direction is given or all share one place.
    """
    every = ((i, row.cells[index]) for i, row in enumerate(block.rows))
    cells = {i: cell for i, cell in every if cell.value is not None and cell.ranked}
    shared = places(cells, columns[index])
    return {i: mark for mark, rows in zip((BEST, SECOND), shared, strict=False) for i in rows if len(shared) > 1}


def places(cells: Mapping[int, Cell], column: Column) -> list[list[int]]:
    """Rows that share a place, the best first; all share one in a column without a direction.

    Down the means, a new place begins where a row is worse than one of the place above beyond the noise. So none stands
    above a row with a better mean, and two rows of one place are never separate.

    >>> places(dict(enumerate([Cell(24.0, 0.1, 3), Cell(25.0, 0.1, 3), Cell(25.1, 0.1, 3)])), Column("PSNR", 2, True))
    [[2, 1], [0]]
    """
    better = better_rows(cells, column)
    sign = -1.0 if column.higher_is_better else 1.0
    found: list[list[int]] = []
    for i in sorted(cells, key=lambda i: sign * (cells[i].value or 0.0)):
        if found and better[i].isdisjoint(found[-1]):
            found[-1].append(i)
        else:
            found.append([i])
    return found


def better_rows(cells: Mapping[int, Cell], column: Column) -> dict[int, set[int]]:
    """Row -> the rows that are better beyond the noise, by the column's own direction; none if it has no direction.

    What prints the same is equally good.
    """
    sign = {True: 1.0, False: -1.0, None: math.nan}[column.higher_is_better]
    numbers = {i: sign * (cell.value or 0.0) for i, cell in cells.items()}
    printed = {i: float(shown(number, column)) for i, number in numbers.items()}
    alone = pooled_variance(cells.values())

    def is_better(i: int, j: int) -> bool:
        ahead = numbers[j] - numbers[i]
        # Most pairs are decided by the first of these, and the last takes the time of a t-test.
        return ahead > 0 and printed[i] != printed[j] and ahead > _least_difference(cells[i], cells[j], alone)

    return {i: {j for j in cells if is_better(i, j)} for i in cells}


def pooled_variance(cells: Collection[Cell]) -> tuple[float, int]:
    """Variance of one run about the mean of its cell, over all cells with more than one, and its degrees of freedom.

    A single pair of seeds says next to nothing (t = 12.7): it counts as none.
    """
    freedom = sum(cell.count - 1 for cell in cells if cell.std is not None)
    squares = sum((cell.count - 1) * cell.std**2 for cell in cells if cell.std is not None)
    return (squares / freedom, freedom) if freedom > 1 else (0.0, 0)


def quantile(freedom: float, tests: int = 1) -> float:
    """Student's t that leaves `1 - CONFIDENCE` outside both its ends, shared among some tests (Bonferroni).

    >>> round(quantile(2), 3), round(quantile(2, tests=2), 3)
    (4.303, 6.205)
    """
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 1 - (1 - CONFIDENCE) / (2 * tests)))


def _least_difference(first: Cell, second: Cell, alone: tuple[float, int]) -> float:
    """By how much two means must differ: Welch's test, with the degrees of freedom after Satterthwaite.

    These are for two estimates of variance that know nothing of each other. Of two single runs there is but one.
    """
    parts = [(c.std**2, c.count - 1) if c.std is not None else alone for c in (first, second)]
    shares = [(variance / c.count, df) for (variance, df), c in zip(parts, (first, second), strict=True)]
    total = sum(share for share, _ in shares)
    if not total:
        return 0.0
    single = first.std is None and second.std is None
    freedom = alone[1] if single else total**2 / sum(share**2 / df for share, df in shares if share)
    return quantile(freedom) * math.sqrt(total)
