"""Tables, charts and a page from finished runs, without torch. Every number comes from a `result.json`, from the log
beside it, or from the file of published numbers.

`frame` puts all runs into one data frame, a row a run. A report is a function of a `selection.RunSet` (that frame and a
request) that returns a `Table`, a list of `Chart`s or a page; `writers` turns them into files. Tables are data in
`tables.yaml`, and `build` makes them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml


@dataclass(frozen=True)
class Report:
    """An entry of `padgs report`."""

    function: str  # "package.module:function", and an argument; imported when needed
    experiments: tuple[str, ...] = ()  # of conf/experiment, run for it; none for sweeps and lists of all runs


TABLES: Mapping[str, Mapping[str, Any]] = {  # see `specs.Spec`
    name: fields
    for name, fields in yaml.safe_load(Path(__file__).with_name("tables.yaml").read_text("utf-8")).items()
    if not name.startswith(".")
}
QUALITY_ORDER = ("order", "photographs", "parallax")
ALL_METHODS = tuple(TABLES["table1"]["experiments"])
REPORTS: Mapping[str, Report] = {
    **{name: Report(f"padgs.reports.build:table {name}", (*fields["experiments"],)) for name, fields in TABLES.items()},
    "stability": Report("padgs.reports.robustness:stability", ("stress",)),
    "limits": Report("padgs.reports.robustness:limits", ("stress",)),
    "smallest": Report("padgs.reports.smallest:table", ("smallest",)),
    "smallest_chart": Report("padgs.reports.smallest:charts", ("smallest",)),
    "chart": Report("padgs.reports.charts.trade_off_chart:charts", ("pareto", *QUALITY_ORDER, *ALL_METHODS)),
    "equal_time_chart": Report("padgs.reports.charts.trade_off_chart:equal_time_charts", ("equal_time",)),
    "gallery": Report("padgs.reports.charts.gallery:charts", ("equal_time", *QUALITY_ORDER, *ALL_METHODS)),
    "sweep": Report("padgs.reports.charts.sweep_chart:charts"),
    "findings": Report("padgs.reports.claims:findings"),
    "html": Report("padgs.reports.page.page:html"),
}
