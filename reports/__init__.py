"""Tables, charts and a page from finished runs. Nothing here trains, renders or imports torch; every number comes from
a `result.json`, from the log beside it, or from the file of published numbers.

`frame` puts all runs into one data frame, a row a run. A report is a function of `Gathered`, that frame and what is
asked of it, and gives a `Table`, a list of `Chart`s or a page; `files` writes any of them down.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Report:
    """What can be asked for."""

    function: str  # "package.module:function", imported when it is wanted
    experiments: tuple[str, ...] = ()  # of conf/experiment that are run for it; none for sweeps and lists of all runs


OF_AN_ORDER = ("order", "photographs", "parallax")
OF_ALL_METHODS = ("table1_360roam", "table2_ricoh360", "table4_efficiency", "all_methods")

REPORTS: Mapping[str, Report] = {
    "table1": Report("padgs.reports.tables.tables_of_methods:table1", OF_ALL_METHODS),
    "table2": Report("padgs.reports.tables.tables_of_methods:table2", OF_ALL_METHODS),
    "table3": Report("padgs.reports.tables.variants:table3", ("ablation", "ablation_bar", "ablation_cat_tower")),
    "table4": Report("padgs.reports.tables.tables_of_methods:table4", OF_ALL_METHODS),
    "methods": Report("padgs.reports.tables.side_by_side:methods", (*OF_ALL_METHODS, "calibration")),
    "equal_time": Report("padgs.reports.tables.side_by_side:equal_time", ("equal_time",)),
    "ladder": Report("padgs.reports.tables.variants:ladder", ("ladder",)),
    "quirks": Report("padgs.reports.tables.variants:quirks", ("deviations",)),
    "order": Report("padgs.reports.tables.order:order", (*OF_AN_ORDER, "pixel_constants")),
    "length": Report("padgs.reports.tables.length:length", ("length",)),
    "learning_rates": Report("padgs.reports.tables.learning_rates:learning_rates", ("learning_rates",)),
    "modulation": Report("padgs.reports.tables.modulation:modulation", ("modulation",)),
    "plus_ablation": Report("padgs.reports.tables.variants:plus_ablation", ("plus_ablation",)),
    "stability": Report("padgs.reports.tables.stability:stability", ("stress",)),
    "limits": Report("padgs.reports.tables.limits:limits", ("stress",)),
    "capacity": Report("padgs.reports.tables.capacity:capacity", ("capacity",)),
    "need": Report("padgs.reports.tables.need:need", ("need",)),
    "smallest_chart": Report("padgs.reports.charts.smallest_chart:charts", ("need",)),
    "runs": Report("padgs.reports.tables.runs:runs"),
    "chart": Report("padgs.reports.charts.trade_off_chart:charts", ("pareto", *OF_AN_ORDER, *OF_ALL_METHODS)),
    "gallery": Report("padgs.reports.charts.gallery:charts", ("equal_time", *OF_AN_ORDER, *OF_ALL_METHODS)),
    "sweep": Report("padgs.reports.charts.sweep_chart:charts"),
    "findings": Report("padgs.reports.findings.page:findings"),
    "html": Report("padgs.reports.page.page:html"),
}
