"""Which results a table is made of: those of its experiments, in settings that have a name."""

from __future__ import annotations

from collections.abc import Sequence

from padgs.results import Result
from reports.request import Request

EXPERIMENTS = {  # table -> experiments (conf/experiment) that are run for it
    "table1": ("table1_360roam", "all_methods"),
    "table2": ("table2_ricoh360", "all_methods"),
    "table3": ("ablation", "ablation_bar", "ablation_cat_tower"),
    "table4": ("table4_efficiency", "table1_360roam", "table2_ricoh360", "all_methods"),
}


def chosen(results: Sequence[Result], table: str, request: Request) -> list[Result]:
    """The results for a table: those of the experiment asked for, else of the table's own, else all.

    A folder may hold sweeps and trials beside the runs of a table; without the choice they would compete for its cells.
    """
    admitted = [result for result in results if request.admits(result)]
    if request.experiment:
        return admitted
    own = [result for result in admitted if {name.partition("@")[0] for name in result.experiments} & _names(table)]
    return own or admitted


def _names(table: str) -> set[str]:
    return set(EXPERIMENTS.get(table, ()))
