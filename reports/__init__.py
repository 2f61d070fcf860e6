"""Tables, charts and a page from finished runs, without torch. Every number comes from a `result.json`, from the log
beside it, or from the file of published numbers.

`frame` puts all runs into one data frame, a row a run. A report is a function of a `selection.RunSet` (that frame and a
request) that returns a `Table`, a list of `Chart`s or a page; `writers` turns them into files. Tables are data in
`specs`, and `build` makes them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Report:
    """An entry of `padgs report`."""

    function: str  # "package.module:function", and an argument; imported when needed
    experiments: tuple[str, ...] = ()  # of conf/experiment, run for it; none for sweeps and lists of all runs


QUALITY_ORDER = ("order", "photographs", "parallax")
ALL_METHODS = ("table1_360roam", "table2_ricoh360", "table4_efficiency", "all_methods")

_TABLES = {  # of padgs.reports.specs -> experiments
    "table1": ALL_METHODS,
    "table2": ALL_METHODS,
    "table3": ("ablation", "ablation_bar", "ablation_cat_tower"),
    "table4": ALL_METHODS,
    "methods": (*ALL_METHODS, "calibration"),
    "equal_time": ("equal_time",),
    "ladder": ("ladder",),
    "deviations": ("deviations",),
    "order": (*QUALITY_ORDER, "pixel_constants", "all_methods"),
    "length": ("length",),
    "learning_rates": ("learning_rates",),
    "modulation": ("modulation",),
    "plus_ablation": ("plus_ablation",),
    "capacity": ("capacity",),
    "runs": (),
}
REPORTS: Mapping[str, Report] = {
    **{name: Report(f"padgs.reports.build:table {name}", experiments) for name, experiments in _TABLES.items()},
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
