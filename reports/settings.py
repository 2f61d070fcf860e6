"""Runs that differ in nothing but the seed are one setting; what a setting is called among others; which runs count."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from padgs.results import Result
from reports import methods
from reports.request import Request, admitted, value_of
from reports.tables.cells import NO_SETTING, different_keys

METHODS = ("table1_360roam", "table2_ricoh360", "all_methods")
EXPERIMENTS = {  # report -> experiments (conf/experiment) that are run for it
    "table1": METHODS,
    "table2": METHODS,
    "table3": ("ablation", "ablation_bar", "ablation_cat_tower"),
    "table4": ("table4_efficiency", *METHODS),
    "methods": METHODS,
    "equal_time": ("equal_time",),
    "quirks": ("quirks",),
    "ladder": ("ladder",),
    "chart": ("pareto", "table4_efficiency", *METHODS),
}


def chosen(results: Sequence[Result], report: str, request: Request) -> list[Result]:
    """The results for a report: those of the experiment asked for; else, scene by scene, those of the report's own
    experiments, or those of none; all, if that leaves nothing.

    A folder may hold sweeps and trials beside the runs of a table; without the choice they would compete for its cells.
    """
    asked_for = admitted(results, request)
    if request.experiment:
        return asked_for
    names = set(EXPERIMENTS.get(report, ()))
    own = [result for result in asked_for if {name.partition("@")[0] for name in result.experiments} & names]
    scenes = {(result.dataset, result.scene) for result in own}
    free = [r for r in asked_for if not r.experiments and (r.dataset, r.scene) not in scenes]
    return [*own, *free] or asked_for


def of_a_table(experiment: str) -> bool:
    """Whether an experiment is run for a table or the chart, and is no sweep.

    >>> of_a_table("table1_360roam@cpu"), of_a_table("tau@cpu")
    (True, False)
    """
    return any(experiment.partition("@")[0] in names for names in EXPERIMENTS.values())


@dataclass(frozen=True)
class Setting:
    """One setting of a preset and its runs, one for each seed."""

    preset: str
    variant: str
    changed: Mapping[str, Any]  # dotted key -> value, of the keys in which the settings of this preset differ
    runs: tuple[Result, ...]

    @property
    def title(self) -> str:
        """Preset, variant, and what sets it apart."""
        parts = [methods.title(self.preset), self.variant]
        parts += [f"{key.rpartition('.')[2]} {value}" for key, value in self.changed.items()]
        return ", ".join(part for part in parts if part)


def settings(results: Sequence[Result]) -> list[Setting]:
    """The settings among the results of one scene, in the order of the methods and of the changed values."""
    groups: dict[tuple[str, str, str], list[Result]] = {}
    for result in results:
        groups.setdefault((result.preset, result.variant, _without_seed(result.config)), []).append(result)
    found = []
    for preset in methods.ordered(preset for preset, _, _ in groups):
        own = [runs for (name, _, _), runs in groups.items() if name == preset]
        keys = _varied(own)
        made = [Setting(preset, runs[0].variant, _values(runs[0], keys), tuple(runs)) for runs in own]
        found += sorted(made, key=lambda setting: (setting.variant, [sort_key(v) for v in setting.changed.values()]))
    return found


def sort_key(value: Any) -> tuple[bool, float, str]:
    """Numbers by size, then everything else by name."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return (not number, float(value) if number else 0.0, "" if number else str(value))


def _varied(groups: Sequence[Sequence[Result]]) -> list[str]:
    keys: dict[str, None] = {}
    for runs in groups[1:]:
        same_variant = runs[0].variant == groups[0][0].variant
        keys |= dict.fromkeys(different_keys(groups[0][0].config, runs[0].config) if same_variant else ())
    return [key for key in keys if key != "variant"]


def _values(result: Result, keys: Sequence[str]) -> dict[str, Any]:
    return {key: value_of(result, key) for key in keys}


def _without_seed(config: Mapping[str, Any]) -> str:
    kept = {key: value for key, value in config.items() if key not in NO_SETTING}
    data = config.get("data")
    if isinstance(data, Mapping):
        kept["data"] = {key: value for key, value in data.items() if f"data.{key}" not in NO_SETTING}
    return json.dumps(kept, sort_keys=True)
