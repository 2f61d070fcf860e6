"""From results to cells: mean and spread over seeds, failures by their status."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from padgs.results import Result
from reports.published import Published
from reports.tables.table import Cell, ReportError

# Keys that no trained number depends on, and the seed.
NO_SETTING = ("seed", "run", "protocol", "data.path", "data.cache_bytes", "data.read_ahead", "data.device")


def one_setting(results: Sequence[Result], where: str) -> list[Result]:
    """Results of one cell, sorted by seed.

    Raises:
        ReportError: they differ in more than the seed, so that their mean would mean nothing; or not even in that.
    """
    ordered = sorted(results, key=lambda result: result.seed)
    refuse_differences(ordered, where)
    for before, result in pairwise(ordered):
        if result.seed == before.seed:
            raise ReportError(f"{where}: runs {before.run} and {result.run} are the same setting; delete one of them")
    return ordered


def refuse_differences(results: Sequence[Result], where: str) -> None:
    """Results must differ in nothing but the seed, and what no number depends on.

    Raises:
        ReportError: they differ in more.
    """
    for result in results[1:]:
        differing = different_keys(results[0].config, result.config)
        if differing:
            raise ReportError(
                f"{where}: runs {results[0].run} and {result.run} differ in {', '.join(differing)}; "
                f"choose one with --where {differing[0]}=..."
            )


def different_keys(first: Mapping[str, Any], second: Mapping[str, Any], where: str = "") -> list[str]:
    """Dotted keys in which two configurations differ, seeds and what no number depends on left out."""
    found = []
    for key in dict.fromkeys((*first, *second)):
        name = f"{where}{key}"
        if name in NO_SETTING:
            continue
        mine, theirs = first.get(key), second.get(key)
        if isinstance(mine, Mapping) and isinstance(theirs, Mapping):
            found += different_keys(mine, theirs, f"{name}.")
        elif mine != theirs:
            found.append(name)
    return found


def measured(results: Sequence[Result], protocol: str, metric: str) -> Cell:
    """The cell of a metric over the seeds of one setting; missing where nothing was run."""
    return over_seeds(results, lambda r: r.scores[protocol].metrics.get(metric) if protocol in r.scores else None)


def over_seeds(results: Sequence[Result], number: Any) -> Cell:
    """Mean and standard deviation of `number(result)` over the runs that are ok; else why there is none."""
    failed = " ".join(dict.fromkeys(result.status for result in results if not result.ok))
    values = [value for result in results if result.ok and (value := number(result)) is not None]
    return spread(values, failed)


def over_scenes(scenes: Sequence[Sequence[Result]], number: Any) -> Cell:
    """Mean over scenes of `number(result)`, with its spread over the seeds that every scene has.

    Missing where a scene has no number at all: a mean over what happened to finish would compare unequal things.
    """
    values = [{r.seed: value for r in runs if r.ok and (value := number(r)) is not None} for runs in scenes]
    seeds = sorted(set.intersection(*map(set, values))) if values else []
    return spread([math.fsum(of[seed] for of in values) / len(values) for seed in seeds])


def spread(values: Sequence[float], failed: str = "") -> Cell:
    """Mean and sample standard deviation; missing for no values."""
    if not values:
        return Cell(status=failed)
    finite = all(math.isfinite(value) for value in values)
    std = statistics.stdev(values) if len(values) > 1 and finite else None
    return Cell(math.fsum(values) / len(values), std, len(values), failed)


def of_the_paper(number: Published | None) -> Cell:
    """A published number; what the paper does not have is missing."""
    if number is None or number.status == "missing":
        return Cell()
    return Cell(number.value, status="" if number.status == "ok" else number.status)


def difference(ours: Cell, theirs: Cell) -> Cell:
    """Ours minus the paper's; missing where either is."""
    if ours.value is None or theirs.value is None:
        return Cell()
    return Cell(ours.value - theirs.value)
