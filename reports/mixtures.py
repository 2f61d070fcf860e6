"""Runs that must not stand together: the refusal, and the frame in which they stand apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pandas as pd
from pandas import DataFrame

from padgs.reports.frame import CONFIG
from padgs.reports.scenes import Place
from padgs.reports.tables.table import ReportError

WORDED = {"learning_rates": "learning rates ", "data": "data "}  # columns whose values do not say what they are


class Mixture(ReportError):
    """A table that must not be made, because runs differ in what they should share."""

    def __init__(
        self, what: str, advice: str, runs: DataFrame, columns: Sequence[str], apart_in: str = "place"
    ) -> None:
        """Of these runs, which differ in these columns; `apart_in` is the column that could set them apart: place, for
        blocks of their own, or preset, for rows.
        """
        super().__init__(f"{what}; {advice}")
        self.what, self.runs, self.columns, self.apart_in = what, runs, list(columns), apart_in


def apart(runs: DataFrame, mixture: Mixture) -> DataFrame:
    """All runs, those of a mixture with what they differ in behind the name of their scene or preset.

    Raises:
        Mixture: that one, if this tells none of them from another.
    """
    own = runs.loc[mixture.runs.index]
    said = [", ".join(of) for of in zip(*(_words(column, own[column]) for column in mixture.columns), strict=True)]
    names = [_with(name, words) for name, words in zip(own[mixture.apart_in], said, strict=True)]
    if len(set(names)) == own[mixture.apart_in].nunique():
        raise mixture
    found = runs.copy()
    found.loc[own.index, mixture.apart_in] = pd.Series(names, index=own.index, dtype=object)
    return found


def _words(column: str, values: pd.Series) -> pd.Series:
    """What is said of each run: that a key is not set; of a condition, who says nothing contradicts none, and the most
    frequent words stand for it.
    """
    if column.startswith(CONFIG):
        return values.map(lambda value: f"{column.rpartition('.')[2]} {'not set' if value is None else value}")
    words = values.map(lambda value: f"{WORDED.get(column, '')}{value}", na_action="ignore")
    return words.fillna(words.mode().iloc[0])


def _with(name: Place | str, words: str) -> Place | str:
    if isinstance(name, Place):
        return replace(name, apart=", ".join(filter(None, (name.apart, words))))
    return f"{name}_{words}"
