"""By how much all learning rates should rise in short runs, and what a law for it loses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pandas import DataFrame

from padgs.reports import methods
from padgs.reports.conditions import footnotes, refuse_mixture
from padgs.reports.frame import by_conditions, grouped
from padgs.reports.gathered import Gathered
from padgs.reports.learning_rates import LARGEST, PUBLISHED_ITERATIONS, law
from padgs.reports.measures import mark
from padgs.reports.settings import one_setting
from padgs.reports.tables.cells import over_pairs, over_seeds
from padgs.reports.tables.ranking import NOTE
from padgs.reports.tables.table import Block, Cell, Column, Row, Table

RATES = "config.train.learning_rates"  # published, run, or a factor
FACTOR = "factor"
QUALITY = mark("sphere", "ws_psnr")


def learning_rates(gathered: Gathered) -> Table:
    """WS-PSNR for each factor on all learning rates and each length, a block for each scene and method; then what is
    lost where the law chooses, of the factors that were run, instead of the best.

    Raises:
        ReportError: results that must not stand together.
    """
    runs = gathered.of_methods("learning_rates")
    runs = runs.loc[runs["iterations"] > 0]  # a run of seconds that failed before its first has no length
    choices = runs[RATES] if RATES in runs else [None] * len(runs)
    runs = runs.assign(**{FACTOR: list(map(_factor, choices, runs["iterations"]))})
    lengths = sorted(runs["iterations"].unique())
    blocks, runs_of = [], {}
    for title, own in by_conditions(runs, "resolution").items():
        refuse_mixture(own, gathered.request, title, ("protocol", "data"))
        losses = []
        for preset in methods.ordered(own["preset"]):
            where = f"{methods.title(preset)}, {title}"
            alike = own.loc[own["preset"] == preset]
            columns = [_factors(alike.loc[alike["iterations"] == n], f"{where}, {n} iterations") for n in lengths]
            factors = sorted({factor for of in columns for factor in of})
            rows = (Row(f"× {factor:g}", tuple(_quality(of.get(factor)) for of in columns)) for factor in factors)
            blocks.append(Block(where, tuple(rows)))
            losses.append(Row(methods.title(preset), tuple(map(_loss, lengths, columns))))
        blocks.append(Block(f"What the law loses, {title}", tuple(losses), signed=True))
        runs_of[title] = own
    says = ", ".join(f"× {law(n):.2f} after {n}" for n in lengths)
    notes = (
        *footnotes(runs_of, "sphere"),
        f"The law, √({PUBLISHED_ITERATIONS} / iterations) and at most {LARGEST:g}, says {says} iterations. Its loss is "
        "the difference, seed by seed, of the factor nearest to it (by their ratio) from the one with the best mean.",
    )
    columns = tuple(Column(f"{n} iterations", 2, True) for n in lengths)
    title = "WS-PSNR for factors on all learning rates"
    return Table("learning_rates", title, "Factor", columns, tuple(blocks), (*notes, NOTE))


def _factor(choice: Any, iterations: int) -> float:
    """None: of a run from before there was a choice."""
    return 1.0 if choice in ("published", None) else law(iterations) if choice == "run" else float(choice)


def _factors(runs: DataFrame, where: str) -> dict[float, DataFrame]:
    return {factor: one_setting(own, f"{where}, factor {factor:g}") for (factor,), own in grouped(runs, FACTOR)}


def _quality(runs: DataFrame | None) -> Cell:
    return Cell() if runs is None else over_seeds(runs, [QUALITY])[0]


def _loss(iterations: int, factors: Mapping[float, DataFrame]) -> Cell:
    means = {factor: mean for factor, runs in factors.items() if (mean := _quality(runs).value) is not None}
    if not means:
        return Cell()
    near = min(means, key=lambda factor: abs(math.log(factor / law(iterations))))
    best = max(means, key=lambda factor: means[factor])
    return over_pairs(factors[near], factors[best], QUALITY.name)
