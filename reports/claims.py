"""Tests of the claims in `claims.yaml`: paired t-tests on runs, and a page with the answer first."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import yaml
from pandas import DataFrame

from padgs.reports import REPORTS, methods, published
from padgs.reports.conditions import as_published, refuse_mixture
from padgs.reports.frame import CONFIG, grouped
from padgs.reports.measures import COSTS, Measure, metric
from padgs.reports.published import DATASETS, NOT_TUNED_ON, TUNED_ON, Key, Place
from padgs.reports.selection import Mixture, RunSet, one_setting, settings
from padgs.reports.significance import CONFIDENCE, differ, failures, mean_cell, paired_test
from padgs.reports.table import MISSING, Cell, ReportError
from padgs.reports.writers import Page, rendered
from padgs.results import higher_is_better

HOLDS, FAILS, MIXED = "holds", "does not hold", "depends on the scene"
NOT_REPRODUCED = "not reproduced"  # at sizes or lengths that are not the paper's
UNDECIDED, UNMEASURED = "undecided", "not measured"
LEAST_SEEDS = 2  # of both sides, for a scene to be tested
OURS = "this project"  # source of claims that are not the paper's
OTHER_PATH = "-other-path"  # in the name of a generated scene that is seen from other positions


@dataclass(frozen=True)
class Side:
    """Runs on one side: of one setting, or of several rivals, of which the best mean counts."""

    presets: tuple[str, ...]
    variant: str = ""
    keys: Mapping[str, Any] = field(default_factory=dict)  # dotted key -> value

    def select(self, runs: DataFrame) -> DataFrame:
        """Return the runs on this side."""
        found = runs.loc[runs["preset"].isin(self.presets) & (runs["variant"] == self.variant)]
        for key, value in self.keys.items():
            found = found.loc[found[CONFIG + key] == value] if CONFIG + key in found else found.iloc[:0]
        return found

    @property
    def published(self) -> list[str]:
        """Methods in the file of published numbers."""
        return [f"padgs/{self.variant}" if self.variant else methods.published_as(preset) for preset in self.presets]


@dataclass(frozen=True)
class Claim:
    """An entry of `claims.yaml`, which explains the fields."""

    text: str
    source: str
    report: str | Sequence[str]
    metric: str
    ours: Any
    others: Any
    required: tuple[str, ...] = ()
    scenes: str = ""
    published: Sequence[tuple[int, str, str]] = ()
    published_metric: str = ""
    note: str = ""

    @property
    def sides(self) -> tuple[Side, Side]:
        """Both sides; presets of `ours` with its keys are no rivals."""
        ours, others = (Side(**of) if isinstance(of, dict) else Side(of) for of in (self.ours, self.others))
        return ours, others

    @property
    def experiments(self) -> list[str]:
        """Experiments whose runs are evidence."""
        reports = [self.report] if isinstance(self.report, str) else self.report
        return [experiment for report in reports for experiment in REPORTS[report].experiments]

    @property
    def measure(self) -> Measure:
        """Number that is compared."""
        return COSTS[self.metric] if self.metric in COSTS else metric(*self.metric.split("/"))

    def advantage(self, ours: float, others: float, higher: bool | None) -> float:
        """Return by how much ours is better: a difference, or for costs the logarithm of a ratio."""
        difference = math.log(ours / others) if self.metric in COSTS else ours - others
        return difference if higher else -difference

    def show(self, advantage: float) -> str:
        """Return an advantage as text; NaN: all runs of the claim's method failed."""
        if math.isnan(advantage):
            return MISSING
        if self.metric in COSTS:
            return f"× {math.exp(advantage):.2f}"
        return f"{advantage:+.{self.measure.column.decimals}f}"


@dataclass(frozen=True)
class Evidence:
    """A verdict and its numbers. An advantage is positive where the claim is right."""

    claim: Claim
    scenes: DataFrame  # a row a scene, see `measured`
    p: float = math.nan  # of the paired test over scenes; NaN without one
    verdict: str = UNMEASURED

    @property
    def tested(self) -> DataFrame:
        """Scenes on which both sides have enough seeds."""
        return self.scenes.loc[self.scenes["tested"]] if len(self.scenes) else self.scenes

    @property
    def interval(self) -> tuple[float, float] | None:
        """Interval of the mean advantage over the tested scenes; None for fewer than two."""
        return None if len(self.tested) < 2 else paired_test([*self.tested["advantage"]])[1:]


def load() -> list[Claim]:
    """Return the claims."""
    return [Claim(**entry) for entry in yaml.safe_load(Path(__file__).with_name("claims.yaml").read_text("utf-8"))]


def judge(claims: Sequence[Claim], run_set: RunSet) -> list[Evidence]:
    """Return the evidence for each claim: paired t-tests on the scenes' means over seeds, with Holm's correction for
    all tested claims of the paper, and apart for those of this project; `findings.md.j2` states the rules.
    """
    found = [Evidence(claim, measured(claim, run_set)) for claim in claims]
    found = [replace(one, p=paired_test([*one.tested["advantage"]])[0]) if one.interval else one for one in found]
    for own in (False, True):
        every = enumerate(found)
        tested = sorted((one.p, at) for at, one in every if (one.claim.source == OURS) is own and not math.isnan(one.p))
        adjusted = 0.0
        for rank, (p, at) in enumerate(tested):
            adjusted = max(adjusted, min(1.0, (len(tested) - rank) * p))
            found[at] = replace(found[at], p=adjusted)
    return [replace(one, verdict=_verdict(one)) for one in found]


def _verdict(evidence: Evidence) -> str:
    if evidence.scenes.empty:
        return UNMEASURED
    advantages = evidence.tested["advantage"]
    if len(advantages) < 2:
        return UNDECIDED
    beyond_seeds = advantages[evidence.tested["differs"]]
    if (beyond_seeds > 0).any() and (beyond_seeds < 0).any():
        return MIXED
    if not evidence.p < 1 - CONFIDENCE or ((beyond_seeds > 0) != (advantages.mean() > 0)).any():
        return UNDECIDED
    if advantages.mean() > 0:
        return UNDECIDED if evidence.scenes["failed"].any() else HOLDS
    as_published = evidence.claim.source == OURS or evidence.tested["as published"].all()
    sizes = evidence.tested.sort_values("width")["size"].unique()
    return FAILS if as_published else f"{NOT_REPRODUCED} at {' and '.join(sizes)}"


def in_the_paper(claim: Claim, numbers: Mapping[Key, Cell]) -> dict[str, float]:
    """Return scene -> advantage over the best of the others in the paper's numbers."""
    name, found = claim.published_metric, {}
    known = {key: number.value for key, number in numbers.items() if number.value is not None}
    higher = name == "fps" or (name != "train_hours" and higher_is_better(name))
    best = max if higher else min
    for table, dataset, scene in claim.published:
        keys = ([Key(table, DATASETS[dataset], scene, of, name) for of in side.published] for side in claim.sides)
        ours, others = ([known[key] for key in side if key in known] for side in keys)
        if ours and others:
            found[Place(dataset, scene).heading] = claim.advantage(best(ours), best(others), higher)
    return found


def findings(run_set: RunSet) -> Page:
    """Return the page: the verdict of each claim, the evidence, the scenes, and the rules."""
    numbers, tested = published.load(), judge(load(), run_set)
    paper = [one.verdict for one in tested if one.claim.source != OURS]
    every = dict.fromkeys([HOLDS, *sorted(one.verdict for one in tested)])
    numbered = [*enumerate(tested, 1)]
    verdicts = {verdict: [(no, one) for no, one in numbered if one.verdict == verdict] for verdict in every}
    text = rendered(
        "findings.md.j2",
        paper=paper,
        holding=paper.count(HOLDS),
        failing=sum(verdict.startswith((NOT_REPRODUCED, FAILS)) for verdict in paper),
        verdicts=verdicts,
        as_published=any(one.tested["as published"].any() for one in tested if len(one.tested)),
        notes=[(no, one.claim) for no, one in numbered if one.claim.note],
        evidence=[(one, in_the_paper(one.claim, numbers)) for one in tested],
        marks={"": "", TUNED_ON: " †", NOT_TUNED_ON: " ‡"},
        missing=MISSING,
        least_seeds=LEAST_SEEDS,
        confidence=CONFIDENCE,
    )
    return Page("findings.md", text)


def measured(claim: Claim, run_set: RunSet) -> DataFrame:
    """Return a row for each scene: the advantage of the means over seeds over the best rival's, by the rules in
    `findings.md.j2`.
    """
    runs = run_set.of_experiments(*claim.experiments)
    if claim.scenes:
        runs = runs.loc[[place.outdoor is (claim.scenes == "outdoor") for place in runs["place"]]]
    ours, others = claim.sides
    timed = runs.reindex(columns=[f"{CONFIG}budget.seconds"]).notna().any(axis=1)
    # Costs depend on the machine, and so does the quality after a minute.
    runs = runs.assign(apart=runs["machine"].where(timed | (claim.metric in COSTS), ""))
    shared = ("place", "resolution", "length", "data", "apart")
    best: dict[tuple[str, ...], dict[str, Any]] = {}
    for (place, size, length, *_), alike in grouped(runs, *shared) if len(runs) else ():
        where = f"{claim.text}, {place.scene}, {size}, {length}"
        refuse_mixture(alike, run_set.request, where, ("protocol",))
        try:
            own = one_setting(ours.select(alike), where)
        except Mixture as mixture:  # to separate our side alone would leave it without rivals
            raise ReportError(str(mixture)) from mixture
        if row := _beside_best(claim, own, others.select(alike), where):
            row["tested"] &= {*claim.required} <= {*alike.loc[alike["ok"], "preset"]}
            row |= {"place": place, "scene": place.label, "seen": place.seen, "size": size, "length": length}
            row |= {"width": int(size.partition("x")[0]), "iterations": alike["iterations"].max()}
            row["as published"] = as_published(alike.loc[row.pop("runs")])
            row["failed"] = failures(ours.select(runs.loc[runs["place"] == place]))
            kind = place.seen if place.dataset != published.BUILT_IN else ""
            scene = (place.dataset, place.scene.replace(OTHER_PATH, ""), kind)
            best[scene] = max(row, best.get(scene, row), key=itemgetter("tested", "width", "iterations"))
    rows = DataFrame(sorted(best.values(), key=lambda row: row["place"].rank))
    if claim.source == OURS and len(rows) and (untuned := rows["tested"] & (rows["seen"] == NOT_TUNED_ON)).any():
        rows["tested"] = untuned
    return rows


def _beside_best(claim: Claim, ours: DataFrame, others: DataFrame, where: str) -> dict[str, Any] | None:
    """Return the advantage over the rival with the best mean, its title, and the seeds of both."""
    first, higher = _numbers(claim, ours), claim.measure.column.higher_is_better
    rivals = {}
    for setting in settings(others.drop(index=ours.index, errors="ignore")) if len(others) else ():
        good = one_setting(setting.runs.loc[setting.runs["ok"]], f"{where}, {setting.title}")
        if len(theirs := _numbers(claim, good)):
            rivals[setting.title] = theirs
    if not rivals or (not len(first) and ours["ok"].all()):
        return None
    advantages = {title: claim.advantage(first.mean(), of.mean(), higher) for title, of in rivals.items()}
    rival, advantage = min(advantages.items(), key=itemgetter(1))
    seeds = len(first), len(rivals[rival])
    tested = min(seeds) >= LEAST_SEEDS and math.isfinite(advantage)  # inf: an exact render
    differs = tested and differ(mean_cell([*first]), mean_cell([*rivals[rival]]), claim.measure.column)
    compared = {"rival": rival, "runs": [*first.index, *rivals[rival].index], "seeds": f"{seeds[0]}, {seeds[1]}"}
    return compared | {"advantage": advantage, "differs": differs, "tested": tested}


def _numbers(claim: Claim, runs: DataFrame) -> Any:
    return runs.loc[runs["ok"]].reindex(columns=[claim.metric])[claim.metric].dropna().astype(float)
