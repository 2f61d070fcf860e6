"""Finished runs and what is asked of them; each report of them is made once, whoever asks for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any

from pandas import DataFrame

from padgs.reports import REPORTS
from padgs.reports.measures import marks
from padgs.reports.mixtures import Mixture, apart
from padgs.reports.request import Request, admitted, experiment_of
from padgs.results import BY_ITSELF


@dataclass(frozen=True)
class Gathered:
    """All that a report is made from. Everything raises ReportError if refused."""

    runs: DataFrame  # as `frame` makes it
    request: Request = Request()
    left_out: Sequence[str] = ()  # why which result files could not be used
    warnings: list[str] = field(default_factory=list)  # of the reports made so far: what stands apart, or is not there
    _made: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse at once what no result or table knows."""
        marks(self.request.protocol)
        admitted(self.runs, self.request)

    @property
    def asked_for(self) -> DataFrame:
        """The runs that the request lets in."""
        return admitted(self.runs, self.request)

    def report(self, name: str) -> Any:
        """What the function of an entry of `REPORTS` makes of this; what must not stand together stands apart in it, in
        blocks, rows and charts of its own, unless the request is strict.
        """
        if name not in self._made:
            module, _, function = REPORTS[name].function.partition(":")
            self._made[name] = self._apart(name, getattr(import_module(module), function))
        return self._made[name]

    def _apart(self, name: str, function: Callable[[Gathered], Any]) -> Any:
        gathered, told = self, dict[str, None]()
        while True:
            try:
                made = function(gathered)
            except Mixture as mixture:
                if self.request.strict:
                    raise
                told[mixture.what] = None
                gathered = replace(gathered, runs=apart(gathered.runs, mixture), _made={})
                continue
            self.warnings.extend(f"{name}: {what}, so they stand apart; --where chooses" for what in told)
            return made

    def chosen(self, name: str) -> DataFrame:
        """The runs for a report: those of the experiment asked for; else, scene by scene, those of the report's own
        experiments, or those that were asked for by themselves; all, if that leaves nothing.

        A folder may hold sweeps and trials beside the runs of a table; without the choice they would compete for its
        cells.
        """
        runs = self.asked_for
        if self.request.experiment:
            return runs
        own = self.of_experiments(*REPORTS[name].experiments)
        free = runs.loc[~runs["place"].isin(own["place"]) & (runs["experiments"].map(lambda of: BY_ITSELF in of))]
        return runs.loc[[*own.index, *free.index]] if len(own) + len(free) else runs

    def of_experiments(self, *names: str) -> DataFrame:
        """The runs of some experiments or sweeps, at whatever scale; none if none was run."""
        runs = self.asked_for
        return runs.loc[[not set(names).isdisjoint(map(experiment_of, of)) for of in runs["experiments"]]]

    def of_methods(self, *names: str) -> DataFrame:
        """Those of them that are what their preset says and no more: no rows of an ablation, and no runs that were
        stopped by hand or went on from others, which their `variant` names as well.
        """
        runs = self.of_experiments(*names)
        return runs.loc[runs["variant"] == ""]


def of_a_table(experiment: str) -> bool:
    """Whether an experiment is run for a table or the chart, and is no sweep.

    >>> of_a_table("table1_360roam@cpu"), of_a_table("tau@cpu")
    (True, False)
    """
    return any(experiment_of(experiment) in report.experiments for report in REPORTS.values())
