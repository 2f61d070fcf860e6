"""How a verdict follows from runs.

A claim says that one side is better than another in one number; a line of evidence is the advantage of that side over
the seeds that both have, on one scene under one set of conditions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from statistics import fmean
from typing import Any

from pandas import DataFrame

from padgs.reports.conditions import refuse_mixture
from padgs.reports.frame import CONFIG, grouped
from padgs.reports.gathered import Gathered
from padgs.reports.measures import COSTS, Measure, mark
from padgs.reports.published import DATASETS, Key, Published, scene_title
from padgs.reports.settings import Setting, one_setting, settings
from padgs.reports.tables.cells import spread
from padgs.reports.tables.ranking import pooled_variance, quantile
from padgs.reports.tables.table import Cell
from padgs.results import higher_is_better

NEGLIGIBLE = 0.5  # dB: what a tie may hide where the paper names no difference


class Verdict(Enum):
    """What can be said of a claim."""

    HOLDS = "holds"
    FAILS = "does not hold"
    TIE = "tie"
    MIXED = "depends on the scene"
    UNTESTABLE = "not testable here"
    UNDECIDED = "undecided"  # measured, but with too few seeds for an interval that could tell
    UNMEASURED = "not measured yet"


@dataclass(frozen=True)
class Side:
    """Which runs stand on one side: of one setting, or of several rivals, of which the best mean counts."""

    presets: tuple[str, ...]
    variant: str = ""
    keys: Mapping[str, float] = field(default_factory=dict)  # dotted key -> value
    published: tuple[str, ...] = ()  # methods in baselines/published.csv

    def of(self, runs: DataFrame) -> DataFrame:
        """The runs on this side."""
        found = runs.loc[runs["preset"].isin(self.presets) & (runs["variant"] == self.variant)]
        for key, value in self.keys.items():
            found = found.loc[found[CONFIG + key] == value] if CONFIG + key in found else found.iloc[:0]
        return found


@dataclass(frozen=True)
class Claim:
    """`ours` is better than `others`, by the metric's own direction."""

    place: str  # in the paper
    text: str
    metric: str  # column of the frame
    ours: Side
    others: Side  # what is also in `ours` does not count
    experiments: tuple[str, ...]  # whose runs may judge it; the first is the one to run
    published: tuple[tuple[int, str, str], ...] = ()  # table, data set as results name it, scene
    published_metric: str = ""
    outdoor: bool | None = None  # only scenes like those of Ricoh360, or only others
    dataset: str = ""  # only this data set, as results name it
    apart: tuple[str, ...] = ()  # further columns in which both sides agree
    reasons: Mapping[Verdict, str] = field(default_factory=dict)  # shown with that verdict only

    @property
    def measure(self) -> Measure:
        """How its number is read."""
        return COSTS[self.metric] if self.metric in COSTS else mark(*self.metric.split("/"))

    @property
    def quotient(self) -> bool:
        """Costs are compared by their quotient, which machines share more or less, marks by their difference."""
        return self.metric in COSTS

    def advantage(self, ours: float, others: float, higher: bool | None) -> float:
        """By how much ours is better: a difference, or the logarithm of a quotient."""
        difference = math.log(ours / others) if self.quotient else ours - others
        return difference if higher else -difference


@dataclass(frozen=True)
class Line:
    """The advantage of a claim's side under one set of conditions."""

    where: str
    rivals: int  # settings among the others
    against: str  # the best of them
    advantage: Cell  # over the seeds that both sides have; positive where the claim is right
    half_width: float | None = None  # of the interval of confidence; None where too few seeds tell


@dataclass(frozen=True)
class Judgement:
    """A verdict and what it rests on."""

    verdict: Verdict
    lines: tuple[Line, ...]
    runs: DataFrame  # of all lines


def judge(claim: Claim, gathered: Gathered, negligible: float = NEGLIGIBLE) -> Judgement:
    """Weigh a claim: it holds where a line speaks for it beyond the noise of the seeds, and none against it.

    On each scene the longest runs count that can be compared. The half-width of a line is t s / √n; s, the spread over
    seeds, and its degrees of freedom are pooled over the scenes of the claim, shorter runs included, which more seeds
    can afford; and t is for as many tests as there are rivals on all scenes, because the best of many is partly lucky.

    Args:
        claim: what is said.
        gathered: all runs.
        negligible: an advantage that a tie may hide; where intervals are wider, nothing is decided.

    Raises:
        ReportError: results that must not stand together.
    """
    runs = gathered.of_experiments(*claim.experiments)
    runs = runs.loc[[claim.outdoor in (None, place.outdoor) for place in runs["place"]]]
    if claim.dataset:
        runs = runs.loc[runs["dataset"] == claim.dataset]
    longest: dict[tuple[Any, ...], tuple[Line, list[int]]] = {}  # what is alike, the scene first -> line, its runs
    spreads: list[Cell] = []
    for alike, where, own in _conditions(runs, claim):
        refuse_mixture(own, gathered.request, f"{claim.text}, {where}", ("protocol",))
        ours, rivals = _sides(claim, own, where)
        if rivals:
            spreads.append(spread(_advantages(claim, ours, rivals[0].runs)))
            used = [*ours.index, *(index for rival in rivals for index in rival.runs.index)]
            longest[alike] = Line(where, len(rivals), rivals[0].title, spreads[-1]), used
    lines = [line for line, _ in longest.values()]
    variance, freedom = pooled_variance(spreads)
    if freedom:
        t = quantile(freedom, sum(line.rivals for line in lines))
        lines = [replace(line, half_width=t * math.sqrt(variance / line.advantage.count)) for line in lines]
    used = dict.fromkeys(index for _, indices in longest.values() for index in indices)
    return Judgement(_verdict(lines, claim, negligible), tuple(lines), runs.loc[list(used)])


def in_the_paper(claim: Claim, numbers: Mapping[Key, Published]) -> dict[str, float]:
    """The same advantage in the paper's numbers, over the best of the others: scene -> advantage."""
    metric, found = claim.published_metric, {}
    higher = metric == "fps" or (metric != "train_hours" and higher_is_better(metric))
    for table, dataset, scene in claim.published:
        keys = (
            [Key(table, DATASETS[dataset], scene, method, metric) for method in side.published]
            for side in (claim.ours, claim.others)
        )
        ours, others = ([n.value for key in of if (n := numbers.get(key)) and n.value is not None] for of in keys)
        if ours and others:
            best = max if higher else min
            found[scene_title(dataset, scene)] = claim.advantage(best(ours), best(others), higher)
    return found


def _conditions(runs: DataFrame, claim: Claim) -> Iterator[tuple[tuple[Any, ...], str, DataFrame]]:
    """A scene with what else is alike; the same in words, with a length at which both sides meet there; and their runs.

    Shorter ones come first.
    """
    shared = ["resolution", "data", *claim.apart, *(["machine"] if claim.quotient else [])]
    for alike, own in grouped(runs, "place", *shared) if len(runs) else ():
        place, resolution, *_ = alike
        ours, others = (set(side.of(own)["length"]) for side in (claim.ours, claim.others))
        both = own.loc[own["length"].isin(ours & others)].sort_values("iterations", kind="stable")
        words = [f"{column.rpartition('.')[2]} {own[column].iloc[0]}" for column in claim.apart]
        for length in dict.fromkeys(both["length"]):
            where = ", ".join([place.scene, resolution, *words, str(length)])
            yield tuple(alike), where, own.loc[own["length"] == length]


def _sides(claim: Claim, runs: DataFrame, where: str) -> tuple[DataFrame, list[Setting]]:
    """The runs of the claim's side, and the settings of the others that share seeds with it, the best mean first."""
    ours = one_setting(claim.ours.of(runs), f"{claim.text}, {where}")
    others = settings(claim.others.of(runs).drop(index=ours.index, errors="ignore"))
    seeds = _numbers(claim, ours).keys()
    found = [([n for seed, n in _numbers(claim, made.runs).items() if seed in seeds], made) for made in others]
    known = [(fmean(numbers), made) for numbers, made in found if numbers]
    known.sort(key=lambda pair: pair[0], reverse=bool(claim.measure.column.higher_is_better))
    return ours, [made for _, made in known]


def _numbers(claim: Claim, runs: DataFrame) -> dict[int, float]:
    """Seed -> number, of the runs that have one."""
    few = runs.reindex(columns=["ok", "seed", claim.metric])  # of the hundreds that a selection of rows would copy
    numbers = few.loc[few["ok"]].dropna()
    return dict(zip(numbers["seed"], numbers[claim.metric].astype(float), strict=True))


def _advantages(claim: Claim, ours: DataFrame, others: DataFrame) -> list[float]:
    """One for each seed that both have."""
    first, second = _numbers(claim, ours), _numbers(claim, others)
    higher = claim.measure.column.higher_is_better
    return [claim.advantage(first[seed], second[seed], higher) for seed in sorted(first.keys() & second.keys())]


def _verdict(lines: Sequence[Line], claim: Claim, negligible: float) -> Verdict:
    told = [(line.advantage.value or 0.0, line.half_width) for line in lines if line.half_width is not None]
    if not told:
        return Verdict.UNDECIDED if lines else Verdict.UNTESTABLE if claim.dataset else Verdict.UNMEASURED
    right, wrong = any(value > half for value, half in told), any(-value > half for value, half in told)
    if right and wrong:
        return Verdict.MIXED
    if right or wrong:
        return Verdict.HOLDS if right else Verdict.FAILS
    return Verdict.TIE if all(half <= negligible for _, half in told) else Verdict.UNDECIDED
