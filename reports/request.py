"""What is asked of a report, and which runs may answer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from pandas import DataFrame

from padgs.reports.frame import CONFIG
from padgs.reports.tables.table import ReportError


@dataclass(frozen=True)
class Request:
    """How a report is to be made."""

    protocol: str = "paper"
    mix: bool = False  # let different rules, sizes and run lengths stand in one block
    strict: bool = False  # make nothing where they differ; else they stand apart
    metrics: tuple[str, ...] = ()  # of the curves; empty for those of the protocol and the costs
    experiment: str = ""  # only runs of this experiment or sweep: as results name it, or without the scale
    where: Mapping[str, str] = field(default_factory=dict)  # dotted configuration key -> the value wanted

    def means(self, name: str) -> bool:
        """Whether it asks for an experiment of this name.

        >>> Request(experiment="tau").means("tau@cpu"), Request(experiment="tau@full").means("tau@cpu")
        (True, False)
        """
        return self.experiment in (name, experiment_of(name))


def admitted(runs: DataFrame, request: Request) -> DataFrame:
    """The runs that a request lets in.

    Raises:
        ReportError: no run knows the experiment or a key that it asks for; the message lists those that are known.
    """
    every, known = runs, sorted(set(runs["experiments"].explode().dropna()))
    if request.experiment:
        if not any(map(request.means, known)):
            raise ReportError(f"unknown experiment {request.experiment!r}; known: {', '.join(known) or 'none'}")
        runs = runs.loc[[any(map(request.means, of)) for of in runs["experiments"]]]
    for key, value in request.where.items() if len(every) else ():
        column = f"{CONFIG}{key}"
        if column not in every or every[column].isna().all():
            first = every.iloc[0]
            keys = [name.removeprefix(CONFIG) for name in first.index[first.notna()] if name.startswith(CONFIG)]
            raise ReportError(f"unknown key {key!r}; known in run {first['run']}: {', '.join(keys)}")
        values = runs[column].map(str)
        runs = runs.loc[values == value]
        if runs.empty:
            there = ", ".join(sorted(set(every[column].dropna().map(str))))
            raise ReportError(f"no run has {key}={value}; runs have {there}")
    return runs


def experiment_of(name: str) -> str:
    """The experiment without the scale that it was run at.

    >>> experiment_of("tau@cpu")
    'tau'
    """
    return name.partition("@")[0]
