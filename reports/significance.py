"""Cells from runs (mean and standard deviation over seeds), and significant differences between cells."""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from pandas import DataFrame

from padgs.reports.measures import Measure
from padgs.reports.table import Block, Cell, Column, format_number

BEST, SECOND = "best", "second"
CONFIDENCE = 0.95
NOTE = (
    "Bold: best; underlined: second; rows that seeds cannot separate share a place (Welch's t-test, two-sided, "
    f"{CONFIDENCE:.0%}; a single run is taken to scatter as the seeds of the other rows; where these are no more than "
    "one pair, single runs tie with their equals only)."
)


def unrank(cells: Sequence[Cell]) -> list[Cell]:
    """Return the same numbers, shown but not ranked."""
    return [cell if cell.value is None else replace(cell, ranked=False) for cell in cells]


def over_seeds(runs: DataFrame, measures: Sequence[Measure]) -> list[Cell]:
    """Return a cell for each measure: mean and deviation over successful runs, and the status of failed ones."""
    failed = " ".join(runs.loc[~runs["ok"], "status"].unique())
    numbers = numbers_of(runs, measures).to_numpy()
    return [mean_cell(column[~np.isnan(column)].tolist(), failed) for column in numbers.T]


def over_scenes(runs: DataFrame, scenes: Sequence[str], measures: Sequence[Measure]) -> list[Cell]:
    """Return a cell for each measure: mean over scenes, standard deviation over seeds that every scene has.

    Missing if any scene has no number, because means over different scenes cannot be compared.
    """
    by_seed = numbers_of(runs, measures).groupby([runs["seed"], runs["scene"]]).last()
    found = []
    for measure in measures:
        complete = by_seed[measure.name].unstack("scene").reindex(columns=scenes).dropna()
        found.append(mean_cell([math.fsum(values) / len(scenes) for values in complete.to_numpy()]))
    return found


def numbers_of(runs: DataFrame, measures: Sequence[Measure]) -> DataFrame:
    """Return the numbers of successful runs, a column a measure."""
    return runs.loc[runs["ok"]].reindex(columns=[measure.name for measure in measures]).astype(float)


def mean_cell(values: Sequence[float], failed: str = "") -> Cell:
    """Return mean and sample standard deviation; a missing cell for no values."""
    if not values:
        return Cell(status=failed)
    finite = all(math.isfinite(value) for value in values)
    std = statistics.stdev(values) if len(values) > 1 and finite else None
    return Cell(math.fsum(values) / len(values), std, len(values), failed)


def emphasis(block: Block, index: int, columns: tuple[Column, ...]) -> dict[int, str]:
    """Return row -> BEST or SECOND for the column `index` of a block.

    Cells that are not `ranked` are left out. Nothing is highlighted without a direction, or if all rows tie.
    """
    every = ((i, row.cells[index]) for i, row in enumerate(block.rows))
    cells = {i: cell for i, cell in every if cell.value is not None and cell.ranked}
    shared = places(cells, columns[index])
    return {i: rank for rank, rows in zip((BEST, SECOND), shared, strict=False) for i in rows if len(shared) > 1}


def places(cells: Mapping[int, Cell], column: Column) -> list[list[int]]:
    """Return the rows that share each place, the best first; all share one in a column without a direction.

    Down the means, a new place begins where a row is significantly worse than one of the place above.

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
    """Return row -> the significantly better rows; numbers that print alike are equal.

    No row is better in a column without a direction.
    """
    sign = {True: 1.0, False: -1.0, None: math.nan}[column.higher_is_better]
    numbers = {i: sign * (cell.value or 0.0) for i, cell in cells.items()}
    printed = {i: float(format_number(number, column)) for i, number in numbers.items()}
    pooled = pooled_variance(cells.values())

    def is_better(i: int, j: int) -> bool:
        ahead = numbers[j] - numbers[i]
        # Most pairs are decided by the first of these; the last takes the time of a t-test.
        return ahead > 0 and printed[i] != printed[j] and ahead > _least_difference(cells[i], cells[j], pooled)

    return {i: {j for j in cells if is_better(i, j)} for i in cells}


def pooled_variance(cells: Collection[Cell]) -> tuple[float, int]:
    """Return variance and degrees of freedom of one run about the mean of its cell, pooled over repeated cells.

    One pair of seeds in all says next to nothing (t = 12.7) and counts as none.
    """
    freedom = sum(cell.count - 1 for cell in cells if cell.std is not None)
    squares = sum((cell.count - 1) * cell.std**2 for cell in cells if cell.std is not None)
    return (squares / freedom, freedom) if freedom > 1 else (0.0, 0)


def _least_difference(first: Cell, second: Cell, pooled: tuple[float, int]) -> float:
    """Return the least significant difference of two means: Welch's test with Satterthwaite's degrees of freedom.

    Two single runs share one pooled estimate of the variance, with its own degrees of freedom.
    """
    from scipy.special import stdtrit

    parts = [(c.std**2, c.count - 1) if c.std is not None else pooled for c in (first, second)]
    shares = [(variance / c.count, df) for (variance, df), c in zip(parts, (first, second), strict=True)]
    total = sum(share for share, _ in shares)
    if not total:
        return 0.0
    single = first.std is None and second.std is None
    freedom = pooled[1] if single else total**2 / sum(share**2 / df for share, df in shares if share)
    return float(stdtrit(freedom, 1 - (1 - CONFIDENCE) / 2)) * math.sqrt(total)
