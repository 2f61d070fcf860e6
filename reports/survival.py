"""What is left of a method under stress: its retention, condition by condition and level by level.

The retention is what a run under stress keeps of what the same method shows without it, above one colour for all:
(Q - one colour) / (Q without - one colour without), within [0, 1], by the WS-PSNR of the protocol `stability`. A run
that failed keeps nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property

import pandas as pd
from pandas import DataFrame

from padgs.reports import methods
from padgs.reports.conditions import refuse_mixture
from padgs.reports.frame import CONFIG, by_conditions, grouped
from padgs.reports.gathered import Gathered
from padgs.reports.settings import one_setting, refuse_differences
from padgs.reports.tables.cells import spread
from padgs.reports.tables.table import Cell
from padgs.results import file_name

CONDITION, LEVEL = f"{CONFIG}stress.condition", f"{CONFIG}stress.level"
QUALITY, ONE_COLOR = "stability/ws_psnr", "stability/ws_psnr_one_color"
ALIKE = ("resolution", "learning_rates", "data", "machine")  # iterations: a condition may change them
# Conditions that are shown, but neither scored nor counted: what some methods cannot be put under, which would be
# neither survived nor failed, and what makes the scene easier, where the quality only rises.
NOT_SCORED = {"precision", "capacity", "textureless"}
HALF = 0.5  # a condition breaks a method where less is kept

Stress = tuple[str, int]  # condition, level


@dataclass(frozen=True)
class Survivor:
    """A method on a scene."""

    preset: str
    runs: Mapping[Stress, DataFrame]  # under each stress, a run a seed
    rest: DataFrame  # the runs without any
    lacks: Set[Stress] = frozenset()  # what other methods of the scene were put under, and it was not

    @cached_property
    def retention(self) -> dict[Stress, Cell]:
        """What it keeps, with the outcomes of runs that failed."""
        return {stress: self._kept(own) for stress, own in self.runs.items()}

    def _kept(self, runs: DataFrame) -> Cell:
        above = (self.rest[QUALITY] - self.rest[ONE_COLOR]).set_axis(self.rest["seed"])
        kept = []
        for _, run in runs.iterrows():
            reference = above.get(run["seed"], above.mean())  # a seed not run at rest has the mean of the others
            share = (run[QUALITY] - run[ONE_COLOR]) / reference if bool(run["ok"]) else 0.0
            kept.append(min(max(share, 0.0), 1.0))
        return spread(kept, " ".join(runs.loc[~runs["ok"], "status"].unique()))

    @property
    def place(self) -> str:
        """Scene and resolution, as a part of file names."""
        first = self.rest.iloc[0]
        return file_name(f"{first['place'].stem}-{first['resolution']}")

    @property
    def conditions(self) -> list[str]:
        """What it was put under, in the order of the runs."""
        return list(dict.fromkeys(condition for condition, _ in self.runs))

    def levels(self, condition: str) -> dict[int, Cell]:
        """What it keeps at each level of a condition."""
        return {level: cell for (name, level), cell in sorted(self.retention.items()) if name == condition}

    def breakdown(self, condition: str) -> int | None:
        """The first level at which it keeps less than half, or a run fails; None where it does not break."""
        broken = (n for n, cell in self.levels(condition).items() if cell.status or (cell.value or 0) < HALF)
        return next(broken, None)

    @property
    def means(self) -> list[float]:
        """What it keeps under each condition, the mean of the levels; the worst first. Empty where it lacks any, for
        means of less say nothing beside means of more.
        """
        scored = {condition for condition, _ in self._scored}
        cells = [self.levels(condition).values() for condition in scored]
        return sorted(math.fsum(cell.value or 0.0 for cell in of) / len(of) for of in cells)

    @property
    def score(self) -> float | None:
        """The mean of the conditions."""
        return spread(self.means).value

    @property
    def worst_quartile(self) -> float | None:
        """The mean of the worst quarter of the conditions, one at least."""
        return spread(self.means[: max(1, len(self.means) // 4)]).value

    @property
    def failure_rate(self) -> float | None:
        """Share of the runs under what is scored that failed; None where it lacks any."""
        return float(1 - pd.concat([runs["ok"] for runs in self._scored.values()]).mean()) if self._scored else None

    @property
    def _scored(self) -> dict[Stress, DataFrame]:
        """The runs that are scored; none where it lacks any."""
        return {} if self.lacks else {of: runs for of, runs in self.runs.items() if of[0] not in NOT_SCORED}


def survivors(gathered: Gathered) -> dict[str, list[Survivor]]:
    """The methods of each scene that were run with and without stress, those whose worst quartile keeps most first, and
    last those that have none.

    Raises:
        ReportError: results that must not stand together.
    """
    runs, found = gathered.of_experiments("stress"), {}
    if not {CONDITION, QUALITY, ONE_COLOR} <= {*runs}:
        return found
    stress = zip(runs[CONDITION], runs[LEVEL], strict=True)
    named = ["" if condition is None else f"{condition} {level}" for condition, level in stress]
    runs = runs.loc[runs["variant"] == named]  # another name is that of a run that was stopped by hand, or of a part
    for title, own in by_conditions(runs, "resolution").items():
        refuse_mixture(own, gathered.request, title, ALIKE)
        kept = [one for preset in methods.ordered(own["preset"]) if (one := _survivor(own, preset, title))]
        if kept:
            every = {stress for one in kept for stress in one.runs if stress[0] not in NOT_SCORED}
            kept = [replace(one, lacks=every - one.runs.keys()) for one in kept]
            found[title] = sorted(kept, key=lambda one: math.inf if one.lacks else -(one.worst_quartile or 0.0))
    return found


def in_order(survivors: Sequence[Survivor]) -> list[Stress]:
    """What any of them was put under, each once, the levels of a condition together."""
    conditions = list(dict.fromkeys(condition for one in survivors for condition in one.conditions))
    return sorted({stress for one in survivors for stress in one.runs}, key=lambda s: (conditions.index(s[0]), s[1]))


def _survivor(runs: DataFrame, preset: str, where: str) -> Survivor | None:
    own, where = runs.loc[runs["preset"] == preset], f"{where}, {methods.title(preset)}"
    refuse_differences(own.drop(columns=[CONDITION, LEVEL]), where)
    rest, stressed = own.loc[own[CONDITION].isna() & own["ok"]], own.loc[own[CONDITION].notna()]
    cells = {
        (condition, int(level)): one_setting(alike, f"{where}, {condition} {level}")
        for (condition, level), alike in grouped(stressed, CONDITION, LEVEL)
    }
    return Survivor(preset, cells, one_setting(rest, where)) if cells and len(rest) else None
