"""What is asked of a report, and which runs may answer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from pandas import DataFrame

from reports.frame import CONFIG
from reports.tables.table import ReportError


@dataclass(frozen=True)
class Request:
    """How a report is to be made."""

    protocol: str = "paper"
    mix: bool = False  # let different rules, sizes and run lengths stand in one block
    metrics: tuple[str, ...] = ()  # of the curves; empty for those of the protocol and the costs
    experiment: str = ""  # only runs of this experiment or sweep, by the name that results give it
    where: Mapping[str, str] = field(default_factory=dict)  # dotted configuration key -> the value wanted


def admitted(runs: DataFrame, request: Request) -> DataFrame:
    """The runs that a request lets in.

    Raises:
        ReportError: no run knows the experiment or a key that it asks for; the message lists those that are known.
    """
    every, known = runs, sorted(set(runs["experiments"].explode().dropna()))
    if request.experiment:
        if request.experiment not in known:
            raise ReportError(f"unknown experiment {request.experiment!r}; known: {', '.join(known) or 'none'}")
        runs = runs.loc[[request.experiment in of for of in runs["experiments"]]]
    for key, value in request.where.items() if len(every) else ():
        column = f"{CONFIG}{key}"
        if column not in every or every[column].isna().all():
            first = every.iloc[0]
            keys = [name.removeprefix(CONFIG) for name in first.index[first.notna()] if name.startswith(CONFIG)]
            raise ReportError(f"unknown key {key!r}; known in run {first['run']}: {', '.join(keys)}")
        runs = runs.loc[runs[column].map(str) == value]
    return runs
