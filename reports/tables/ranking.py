"""Which numbers of a column stand out: the best and the second, by the column's own direction and beyond the noise."""

from __future__ import annotations

import math

from reports.tables.table import Block, Cell, Column, shown

BEST, SECOND = "best", "second"
STANDARD_ERRORS = 2.0  # two means that differ by less, in standard errors of their difference, are a tie
NOTE = (
    f"Bold: best; underlined: second; neither where two means differ by less than {STANDARD_ERRORS:g} standard errors "
    "of their difference over the seeds."
)


def emphasis(block: Block, index: int, columns: tuple[Column, ...]) -> dict[int, str]:
    """Row -> BEST or SECOND for the column `index` of a block.

    Cells that are not `ranked` are left out. What prints the same is equally good. A tie inside the noise leaves the
    place empty, and those below it too. Nothing stands out where no direction is given or all numbers are the same.
    """
    column = columns[index]
    every = ((i, row.cells[index]) for i, row in enumerate(block.rows))
    cells = {i: cell for i, cell in every if cell.value is not None and cell.ranked}
    if column.higher_is_better is None or len({shown(cell.value or 0.0, column) for cell in cells.values()}) < 2:
        return {}
    found: dict[int, str] = {}
    for place in (BEST, SECOND):
        if not cells:
            break
        first = _first(cells, column)
        lead = next(iter(first.values()))
        if any(within_noise(lead, cell) for i, cell in cells.items() if i not in first):
            break
        found |= dict.fromkeys(first, place)
        cells = {i: cell for i, cell in cells.items() if i not in first}
    return found


def within_noise(first: Cell, second: Cell) -> bool:
    """Whether the spread over seeds could explain the difference; never where no cell has a spread.

    A single run beside a mean over seeds is taken to scatter as the seeds do.

    >>> within_noise(Cell(25.0, 0.1, 3), Cell(25.1, 0.1, 3)), within_noise(Cell(25.0, 0.1, 3), Cell(25.5, 0.1, 3))
    (True, False)
    """
    if first.value is None or second.value is None or first.std is second.std is None:
        return False
    spreads = [cell.std if cell.std is not None else other.std for cell, other in ((first, second), (second, first))]
    error = math.sqrt(sum((s or 0.0) ** 2 / c.count for s, c in zip(spreads, (first, second), strict=True)))
    return abs(first.value - second.value) < STANDARD_ERRORS * error


def _first(cells: dict[int, Cell], column: Column) -> dict[int, Cell]:
    numbers = {i: float(shown(cell.value, column)) for i, cell in cells.items() if cell.value is not None}
    best = max(numbers.values()) if column.higher_is_better else min(numbers.values())
    return {i: cells[i] for i, number in numbers.items() if number == best}
