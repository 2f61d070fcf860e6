"""All that a folder of runs gives: its tables and charts, each made once, whoever asks for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from padgs.results import Result
from reports.charts import sweep_chart, trade_off_chart
from reports.charts.drawing import Chart
from reports.charts.sweeps import Sweep, sweeps
from reports.charts.trade_off import TradeOff, trade_offs
from reports.measures import marks
from reports.request import Request, admitted
from reports.store import Run
from reports.tables import ladder, quirks, runs, side_by_side, table3, tables_of_methods
from reports.tables.table import Table

TABLES: Mapping[str, Callable[[Sequence[Result], Request], Table]] = {
    "table1": tables_of_methods.table1,
    "table2": tables_of_methods.table2,
    "table3": table3.build,
    "table4": tables_of_methods.table4,
    "methods": side_by_side.methods,
    "equal_time": side_by_side.equal_time,
    "ladder": ladder.build,
    "quirks": quirks.build,
    "runs": runs.build,
}


@dataclass(frozen=True)
class Gathered:
    """Finished runs, and what is asked of them. Everything raises ReportError if refused."""

    runs: Sequence[Run]
    request: Request
    left_out: Sequence[str] = ()  # why which result files could not be used

    def __post_init__(self) -> None:
        """Refuse at once what no result or table knows."""
        marks(self.request.protocol)
        admitted(self.results, self.request)

    @cached_property
    def results(self) -> list[Result]:
        """What the runs have to say for themselves."""
        return [run.result for run in self.runs]

    def table(self, name: str) -> Table:
        """A table of `TABLES`."""
        if name not in self._tables:
            self._tables[name] = TABLES[name](self.results, self.request)
        return self._tables[name]

    @cached_property
    def sweeps(self) -> list[tuple[Sweep, Chart]]:
        """Each sweep and its picture."""
        return [(sweep, sweep_chart.chart(sweep)) for sweep in sweeps(self.results, self.request)]

    @cached_property
    def trade_offs(self) -> list[tuple[TradeOff, list[Chart]]]:
        """Speed against accuracy with its picture, and quality over training time where runs left a log."""
        found, logs = [], {run.result.run: run.log for run in self.runs}
        for made in trade_offs(self.results, self.request):
            over_time = trade_off_chart.time_chart(made, logs)
            found.append((made, [trade_off_chart.chart(made), *([over_time] if over_time else [])]))
        return found

    @cached_property
    def _tables(self) -> dict[str, Table]:
        return {}
