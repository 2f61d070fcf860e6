"""Cells from runs (mean and standard deviation over seeds), and significant differences between cells."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pandas import DataFrame

from padgs.reports.measures import Measure
from padgs.reports.published import Place
from padgs.reports.table import Block, Cell, Column, Row, format_number

BEST, SECOND = "best", "second"
CONFIDENCE = 0.95
SEEDS = 3  # at least, of a row that is marked as best or second
WIDEST = 0.02  # largest difference of rows that share a mark, as a share of their number


def unrank(cells: Sequence[Cell]) -> list[Cell]:
    """Return the same numbers, shown but not ranked."""
    return [cell if cell.value is None else replace(cell, ranked=False) for cell in cells]


def over_seeds(runs: DataFrame, measures: Sequence[Measure]) -> list[Cell]:
    """Return a cell for each measure: mean and deviation over successful runs, and the status of failed ones."""
    failed = failures(runs)
    return [mean_cell(column[~np.isnan(column)].tolist(), failed) for column in numbers_of(runs, measures).T]


def failures(runs: DataFrame) -> str:
    """Return the statuses of failed runs, each once."""
    return " ".join(runs.loc[~runs["ok"], "status"].unique())


def over_scenes(runs: DataFrame, scenes: Sequence[Place], measures: Sequence[Measure]) -> list[Cell]:
    """Return a cell for each measure: mean over scenes, standard deviation over seeds that every scene has.

    Missing if any scene has no number, because means over different scenes cannot be compared. The status of failed
    runs stands beside it, since their seeds are left out.
    """
    failed = failures(runs.loc[runs["place"].isin(scenes)])
    by_seed: dict[int, dict[Place, NDArray]] = {}
    for seed, place, numbers in zip(runs["seed"], runs["place"], numbers_of(runs, measures), strict=True):
        by_seed.setdefault(seed, {})[place] = numbers
    complete = [[of[place] for place in scenes] for _, of in sorted(by_seed.items()) if of.keys() >= {*scenes}]
    means = [[math.fsum(numbers) / len(scenes) for numbers in zip(*of, strict=True)] for of in complete]
    known = ([mean for mean in of if not math.isnan(mean)] for of in zip(*means, strict=True))
    return [mean_cell(mean, failed) for mean in known] if complete else [Cell(status=failed) for _ in measures]


def numbers_of(runs: DataFrame, measures: Sequence[Measure]) -> NDArray:
    """Return the numbers [run, measure]; NaN where a run failed or has none."""
    found = runs.reindex(columns=[measure.name for measure in measures]).to_numpy(float)
    return np.where(runs["ok"].to_numpy()[:, None], found, np.nan)


def mean_cell(values: Sequence[float], failed: str = "") -> Cell:
    """Return mean and sample standard deviation; a missing cell for no values."""
    if not values:
        return Cell(status=failed)
    finite = all(math.isfinite(value) for value in values)
    std = statistics.stdev(values) if len(values) > 1 and finite else None
    return Cell(math.fsum(values) / len(values), std, len(values), failed)


def marks(block: Block, columns: tuple[Column, ...]) -> list[dict[int, str]]:
    """Return row -> BEST or SECOND for each column of a block; see the notes in `tables.yaml`."""
    if block.across is None:
        return [emphasis(block, index, columns) for index in range(len(columns))]
    turned = (Block("", tuple(Row("", (cell,)) for cell in row.cells)) for row in block.rows)
    rows = [emphasis(row, 0, (block.across,)) for row in turned]
    return [{number: row[index] for number, row in enumerate(rows) if index in row} for index in range(len(columns))]


def emphasis(block: Block, index: int, columns: tuple[Column, ...]) -> dict[int, str]:
    """Return row -> BEST or SECOND for the column `index` of a block; see the notes in `tables.yaml`.

    Cells that are not `ranked` are left out. Nothing is highlighted without a direction, or if all rows tie.
    """
    column, every = columns[index], ((i, row.cells[index]) for i, row in enumerate(block.rows))
    cells = {i: cell for i, cell in every if cell.value is not None and cell.ranked}
    sign = -1.0 if column.higher_is_better else 1.0
    few = min((sign * (cell.value or 0.0) for cell in cells.values() if is_few(cell)), default=math.inf)
    shared = places({i: cell for i, cell in cells.items() if not is_few(cell)}, column)
    found: dict[int, str] = {}
    for rank, rows in zip((BEST, SECOND), shared if len(shared) > 1 else (), strict=False):
        numbers = [sign * (cells[i].value or 0.0) for i in rows]
        if few <= max(numbers) or max(numbers) - min(numbers) > WIDEST * max(map(abs, numbers)):
            break
        found |= dict.fromkeys(rows, rank)
    return found


def is_few(cell: Cell) -> bool:
    """Return whether a cell has too few seeds for a mark, or failed runs, without which its mean is too good."""
    return cell.count < SEEDS or bool(cell.status)


def places(cells: Mapping[int, Cell], column: Column) -> list[list[int]]:
    """Return the rows that share each place, the best first; all share one in a column without a direction.

    Down the means, a new place begins where a row is significantly worse than one of the place above.

    >>> places(dict(enumerate([Cell(24.0, 0.1, 3), Cell(25.0, 0.1, 3), Cell(25.1, 0.1, 3)])), Column("PSNR", 2, True))
    [[2, 1], [0]]
    """
    sign = -1.0 if column.higher_is_better else 1.0
    found: list[list[int]] = []
    for i in sorted(cells, key=lambda i: sign * (cells[i].value or 0.0)):
        if found and not any(differ(cells[i], cells[j], column) for j in found[-1]):
            found[-1].append(i)
        else:
            found.append([i])
    return found


def paired_test(differences: Sequence[float]) -> tuple[float, float, float]:
    """Return p of a two-sided paired t-test of some differences, and the ends of their mean's interval.

    Equal differences other than zero give 0. As `scipy.stats.ttest_rel`, which takes two seconds to import.
    """
    from scipy.special import stdtr, stdtrit

    count, mean = len(differences), statistics.fmean(differences)
    error = statistics.stdev(differences) / math.sqrt(count)
    reach = float(stdtrit(count - 1, (1 + CONFIDENCE) / 2)) * error
    p = 2 * float(stdtr(count - 1, -abs(mean) / error)) if error else float(not mean)
    return p, mean - reach, mean + reach


def differ(first: Cell, second: Cell, column: Column) -> bool:
    """Return whether two means differ significantly (Welch's t-test); numbers that print alike do not."""
    from scipy.special import stdtr

    printed = {format_number(cell.value or 0.0, column) for cell in (first, second)}
    if column.higher_is_better is None or len(printed) == 1:
        return False
    counts, difference = (first.count, second.count), (first.value or 0.0) - (second.value or 0.0)
    errors = [(cell.std or 0.0) ** 2 / cell.count for cell in (first, second)]
    if not (error := sum(errors)):
        return True  # without any spread the means decide
    freedom = error**2 / sum(of**2 / (count - 1) for of, count in zip(errors, counts, strict=True) if of)
    return bool(2 * stdtr(freedom, -abs(difference) / math.sqrt(error)) < 1 - CONFIDENCE)
