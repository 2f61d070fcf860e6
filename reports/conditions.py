"""Under what conditions numbers were made: what runs of one block must share, and what stands under a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import pandas as pd
from pandas import DataFrame

from padgs.reports.methods import name, title
from padgs.reports.mixtures import Mixture
from padgs.reports.request import Request

# Columns of the frame; the protocol's are its rules.
CONDITIONS = ("protocol", "resolution", "length", "learning_rates", "data")
OF_A_DATA_SET = ("protocol", "resolution", "length", "learning_rates")  # scenes may differ, rules may not
OF_A_SWEEP = ("protocol", "machine")  # all else shows as a changed key
OF_A_POINT = ("data",)  # the folder of the data is no part of a setting
OF_A_CHART = ("protocol", "resolution", "learning_rates", "data", "machine")
OF_A_MEAN = (*OF_A_DATA_SET, "machine")  # of one setting over the scenes of a data set
OF_TIMES = (*CONDITIONS, "machine")
OF_PARTS = tuple(what for what in OF_TIMES if what != "learning_rates")  # which may be what a method is without
PUBLISHED_LENGTHS = {"egonerf": 100_000}  # iterations; of the others 30 000, which tables of the paper have
PUBLISHED_WIDTH = 1920  # pixels; the narrowest panoramas of the paper
PUBLISHED_PIXELS = {  # preset -> what of it means something else in narrower panoramas
    "op43dgs_release": "has a low-pass of 0.12 square pixels at a width of 2048, and of 0.0076 at 512",
    "odgs_release": "draws half a pixel off, which is 0.09 degrees at a width of 2048, and 0.35 at 512",
}


def refuse_mixture(runs: DataFrame, request: Request, where: str, conditions: Iterable[str] = CONDITIONS) -> None:
    """Runs of one block must have been made and scored alike.

    Raises:
        Mixture: they were not, and the request does not say that this is meant.
    """
    for what in () if request.mix else conditions:
        values = _values(runs, what, request.protocol).drop_duplicates()
        if len(values) > 1:
            examples = "; ".join(
                f"{value} in {run}" for value, run in zip(values, runs["run"][values.index], strict=True)
            )
            told = f"{where}: results differ in {what} ({examples})"
            column = _column(what, request.protocol)
            raise Mixture(told, "choose with --where, or say --mix if this is meant", runs, [column])


def footnotes(blocks: Mapping[str, DataFrame], protocol: str) -> list[str]:
    """Protocol with all its rules, resolution, length, learning rates, seeds, code version and machine of the runs
    of blocks, in a sentence for all blocks that share them.
    """
    titles: dict[str, list[str]] = {}
    for block, runs in blocks.items():
        titles.setdefault(_sentence(runs, protocol), []).append(block)
    notes = [f"{'; '.join(of)}: {sentence}" for sentence, of in titles.items()]
    for method, length in PUBLISHED_LENGTHS.items():
        if any(((runs["method"] == method) & (runs["iterations"] < length)).any() for runs in blocks.values()):
            notes.append(f"{name(method)} is published with {length} iterations.")
    for preset, what in PUBLISHED_PIXELS.items():
        sizes = (size for runs in blocks.values() for size in runs["resolution"][runs["preset"] == preset])
        if any(int(size.partition("x")[0]) < PUBLISHED_WIDTH for size in sizes):
            notes.append(f"{title(preset)} {what}.")
    return notes


def _sentence(runs: DataFrame, protocol: str) -> str:
    if runs.empty:
        return "not run."
    columns = {what: _values(runs, what, protocol) for what in (*OF_A_DATA_SET, "seed", "code_version", "hardware")}
    columns["seed"] = columns["seed"].sort_values()
    rules, sizes, lengths, rates, seeds, versions, machines = (
        " / ".join(map(str, values.unique())) or "none" for values in columns.values()
    )
    return f"protocol {rules}, {sizes}, {lengths}, learning rates {rates}, seeds {seeds}, padgs {versions}, {machines}."


def _values(runs: DataFrame, what: str, protocol: str) -> pd.Series:
    """A condition of each run; one that was never scored under a protocol contradicts none of its rules."""
    column = _column(what, protocol)
    return runs[column].dropna() if column in runs else pd.Series(dtype=object)


def _column(what: str, protocol: str) -> str:
    return f"{protocol} rules" if what == "protocol" else what
