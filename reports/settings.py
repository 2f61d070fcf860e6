"""Runs that differ in nothing but the seed are one setting; what a setting is called among others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pandas import DataFrame

from padgs.reports import methods
from padgs.reports.frame import CONFIG, decides, grouped
from padgs.reports.mixtures import Mixture
from padgs.reports.tables.table import ReportError


@dataclass(frozen=True)
class Setting:
    """One setting of a preset and its runs, one for each seed."""

    preset: str
    variant: str
    changed: Mapping[str, Any]  # dotted key -> value, of the keys in which the settings of this preset differ
    runs: DataFrame

    @property
    def title(self) -> str:
        """Preset, variant, and what sets it apart."""
        return ", ".join([methods.title(self.preset), *self.apart])

    @property
    def apart(self) -> list[str]:
        """Variant, if any, and what sets it apart."""
        changed = [f"{key.rpartition('.')[2]} {value}" for key, value in self.changed.items()]
        return [self.variant, *changed] if self.variant else changed


def settings(runs: DataFrame) -> list[Setting]:
    """The settings among the runs of one scene, in the order of the methods and of the changed values."""
    found = []
    for preset in methods.ordered(runs["preset"]):
        own = runs.loc[runs["preset"] == preset]
        keys = [key for key in differing(own.loc[own["variant"] == own["variant"].iloc[0]]) if key != "variant"]
        made = [
            Setting(preset, variant, {key: alike[CONFIG + key].iloc[0] for key in keys}, alike)
            for (variant, _), alike in grouped(own, "variant", "setting")
        ]
        found += sorted(made, key=lambda setting: (setting.variant, [sort_key(v) for v in setting.changed.values()]))
    return found


def one_setting(runs: DataFrame, where: str, apart_in: str = "place") -> DataFrame:
    """The runs of one cell, sorted by seed; `apart_in`: see `Mixture`.

    Raises:
        Mixture: they differ in more than the seed, so that their mean would mean nothing.
        ReportError: not even in that.
    """
    ordered = runs.sort_values("seed", kind="stable")
    refuse_differences(ordered, where, apart_in)
    for _, same in grouped(ordered, "seed"):
        if len(same) > 1:
            first, second, *_ = same["run"]
            raise ReportError(f"{where}: runs {first} and {second} are the same setting; delete one of them")
    return ordered


def refuse_differences(runs: DataFrame, where: str, apart_in: str = "place") -> None:
    """Runs must differ in nothing but the seed, and what no number depends on; `apart_in`: see `Mixture`.

    Raises:
        Mixture: they differ in more.
    """
    every = differing(runs)
    for other in range(1, len(runs)) if every else ():
        two = runs.iloc[[0, other]]
        if keys := differing(two):
            told = f"{where}: runs {' and '.join(two['run'])} differ in {', '.join(keys)}"
            columns = [CONFIG + key for key in every]
            raise Mixture(told, f"choose one with --where {keys[0]}=...", runs, columns, apart_in)


def differing(runs: DataFrame) -> list[str]:
    """Dotted keys in which configurations differ, seeds and what no number depends on left out."""
    keys = [name.removeprefix(CONFIG) for name in runs if name.startswith(CONFIG)]
    keys = [key for key in keys if decides(key)]
    values = runs[[CONFIG + key for key in keys]].to_numpy()
    return [key for key, column in zip(keys, values.T, strict=True) if any(value != column[0] for value in column)]


def sort_key(value: Any) -> tuple[bool, float, str]:
    """Numbers by size, then everything else by name."""
    return (not is_number(value), float(value) if is_number(value) else 0.0, "" if is_number(value) else str(value))


def is_number(value: Any) -> bool:
    """Whether it has a place on an axis; True and False have none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)
