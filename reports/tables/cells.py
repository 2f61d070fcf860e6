"""From runs to cells: mean and spread over seeds, failures by their status."""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from pandas import DataFrame

from padgs.reports.measures import Measure
from padgs.reports.settings import one_setting
from padgs.reports.tables.table import Cell


def of_each(
    runs: DataFrame,
    column: str,
    titles: Mapping[str, str],
    where: str,
    measures: Sequence[Measure],
    unranked: Collection[str] = (),
) -> dict[str, list[Cell]]:
    """Value of a column -> a cell for each measure over the runs that have it, in the order of `titles`; those of
    `unranked` values are only shown.

    Raises:
        Mixture: runs of one value differ in more than the seed.
    """
    own = {value: runs.loc[runs[column] == value] for value in titles}
    apart_in = column if column == "preset" else "place"  # rows of a variant have titles of their own
    alike = {value: one_setting(own[value], f"{where}, {title}", apart_in) for value, title in titles.items()}
    cells = {value: over_seeds(runs, measures) for value, runs in alike.items()}
    return {value: only_shown(row) if value in unranked else row for value, row in cells.items()}


def only_shown(cells: Sequence[Cell]) -> list[Cell]:
    """The same numbers, out of the competition; a missing one is not in it anyway."""
    return [cell if cell.value is None else replace(cell, ranked=False) for cell in cells]


def over_seeds(runs: DataFrame, measures: Sequence[Measure]) -> list[Cell]:
    """A cell for each measure: mean and standard deviation over the runs that are ok; else why there is none."""
    failed = " ".join(runs.loc[~runs["ok"], "status"].unique())
    numbers = _numbers(runs, measures).to_numpy()
    return [spread(column[~np.isnan(column)].tolist(), failed) for column in numbers.T]


def over_pairs(ours: DataFrame, others: DataFrame, column: str) -> Cell:
    """Ours minus the others' of a column, over the seeds that both have."""
    first, second = (runs.loc[runs["ok"]].set_index("seed")[column].astype(float) for runs in (ours, others))
    return spread((first - second).dropna().tolist())


def over_scenes(runs: DataFrame, scenes: Sequence[str], measures: Sequence[Measure]) -> list[Cell]:
    """A cell for each measure: mean over scenes, with its spread over the seeds that every scene has.

    Missing where a scene has no number at all: a mean over what happened to finish would compare unequal things.
    """
    by_seed = _numbers(runs, measures).groupby([runs["seed"], runs["scene"]]).last()
    found = []
    for measure in measures:
        complete = by_seed[measure.name].unstack("scene").reindex(columns=scenes).dropna()
        found.append(spread([math.fsum(values) / len(scenes) for values in complete.to_numpy()]))
    return found


def _numbers(runs: DataFrame, measures: Sequence[Measure]) -> DataFrame:
    """Those of the runs that are ok."""
    return runs.loc[runs["ok"]].reindex(columns=[measure.name for measure in measures]).astype(float)


def spread(values: Sequence[float], failed: str = "") -> Cell:
    """Mean and sample standard deviation; missing for no values."""
    if not values:
        return Cell(status=failed)
    finite = all(math.isfinite(value) for value in values)
    std = statistics.stdev(values) if len(values) > 1 and finite else None
    return Cell(math.fsum(values) / len(values), std, len(values), failed)
