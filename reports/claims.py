"""Tests of the claims in `claims.yaml`: paired t-tests on runs, and a page with the answer first."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml
from pandas import DataFrame, concat

from padgs.reports import REPORTS, methods, published
from padgs.reports.conditions import refuse_mixture
from padgs.reports.frame import CONFIG, grouped
from padgs.reports.measures import COSTS, Measure, metric
from padgs.reports.published import DATASETS, Key, Place, Published
from padgs.reports.selection import RunSet, one_setting, settings
from padgs.reports.significance import CONFIDENCE
from padgs.reports.table import MISSING
from padgs.reports.writers import Page
from padgs.results import higher_is_better

HOLDS, FAILS, MIXED = "holds", "does not hold", "depends on the scene"
UNDECIDED, UNMEASURED = "undecided", "not measured"
LEAST_SCENES = 3  # from which on scenes are the units of the test; seeds otherwise


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
    scenes: str = ""
    within: tuple[str, ...] = ()
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
        """Return an advantage as text."""
        return (
            f"× {math.exp(advantage):.2f}" if self.metric in COSTS else f"{advantage:+.{self.measure.column.decimals}f}"
        )


@dataclass(frozen=True)
class Evidence:
    """A verdict and its numbers. An advantage is positive where the claim is right."""

    verdict: str
    pairs: DataFrame  # columns scene, seed, rival, advantage
    interval: tuple[float, float] | None = None  # of the mean advantage, see `CONFIDENCE`; None for a single unit

    @property
    def by_scene(self) -> Any:
        """Mean advantage on each scene, as a series."""
        return self.pairs.groupby("scene")["advantage"].mean()

    @property
    def units(self) -> Any:
        """Advantages that are tested: of scenes, or of seeds if there are few scenes."""
        return self.by_scene if len(self.by_scene) >= LEAST_SCENES else self.pairs["advantage"]


def load() -> list[Claim]:
    """Return the claims."""
    return [Claim(**entry) for entry in yaml.safe_load(Path(__file__).with_name("claims.yaml").read_text("utf-8"))]


def evaluate(claim: Claim, run_set: RunSet) -> Evidence:
    """Test whether the mean advantage differs from zero, by a paired t-test on scenes, or on seeds of few scenes.

    A claim holds (does not hold) if the mean is significantly positive (negative) and so is every scene; it depends on
    the scene if their means have different signs.
    The level is divided by the number of rivals (Bonferroni), because the best rival of many is partly lucky.

    Raises:
        ReportError: runs must not be compared, or are mixed in a cell.
    """
    from scipy.stats import ttest_rel

    found = list(_pairs(claim, run_set))
    if not found:
        return Evidence(UNMEASURED, DataFrame())
    evidence = Evidence(UNDECIDED, concat([own for own, _ in found], ignore_index=True))
    units, by_scene = evidence.units, evidence.by_scene
    if len(units) < 2:
        return evidence
    level = (1 - CONFIDENCE) / max(rivals for _, rivals in found)
    interval = ttest_rel(units, [0.0] * len(units)).confidence_interval(1 - level)
    low, high = float(interval.low), float(interval.high)
    agree = (by_scene > 0).all() or (by_scene < 0).all()
    verdict = MIXED if not agree else HOLDS if low > 0 else FAILS if high < 0 else UNDECIDED
    return replace(evidence, verdict=verdict, interval=(low, high))


def in_the_paper(claim: Claim, numbers: Mapping[Key, Published]) -> dict[str, float]:
    """Return scene -> advantage over the best of the others in the paper's numbers."""
    name, found = claim.published_metric, {}
    higher = name == "fps" or (name != "train_hours" and higher_is_better(name))
    best = max if higher else min
    for table, dataset, scene in claim.published:
        ours, others = (
            [
                number.value
                for method in side.published
                if (number := numbers.get(Key(table, DATASETS[dataset], scene, method, name)))
                and number.value is not None
            ]
            for side in claim.sides
        )
        if ours and others:
            found[Place(dataset, scene).heading] = claim.advantage(best(ours), best(others), higher)
    return found


def findings(run_set: RunSet) -> Page:
    """Return the page: verdicts in words, a table with the evidence, and the rules.

    Raises:
        ReportError: runs must not be compared, or are mixed in a cell.
    """
    numbers, claims = published.load(), load()
    tested = [(claim, evaluate(claim, run_set)) for claim in claims]
    parts = ["# Findings", _answer(tested), "## Evidence", _table(tested, numbers), "## Rules", RULES.strip()]
    return Page("findings.md", "\n\n".join(parts) + "\n")


def _answer(tested: Sequence[tuple[Claim, Evidence]]) -> str:
    paper = [evidence.verdict for claim, evidence in tested if claim.source != "padgs"]
    first = f"Of {len(paper)} claims of the paper, {paper.count(HOLDS)} hold in the runs of this project and "
    first += f"{paper.count(FAILS)} do not; the rest depend on the scene or are undecided."
    lines = []
    for verdict in (HOLDS, FAILS, MIXED, UNDECIDED, UNMEASURED):
        chosen = [claim for claim, evidence in tested if evidence.verdict == verdict]
        texts = [" ".join(filter(None, (f"- {claim.text} ({claim.source}).", claim.note))) for claim in chosen]
        lines += [f"**{verdict.capitalize()}:**\n\n" + "\n".join(texts)] if texts else []
    return "\n\n".join([first, *lines])


def _table(tested: Sequence[tuple[Claim, Evidence]], numbers: Mapping[Key, Published]) -> str:
    lines = [
        "| claim | source | number | advantage | interval | ahead on | strongest rivals | in the paper | verdict |",
        "| --- | --- | --- | ---: | ---: | ---: | --- | --- | --- |",
    ]
    for claim, evidence in tested:
        cells = [claim.text, claim.source, claim.measure.column.title, *[MISSING] * 4]
        if len(evidence.pairs):
            by_scene = evidence.by_scene
            cells[3] = claim.show(evidence.units.mean())
            cells[4] = " to ".join(map(claim.show, evidence.interval)) if evidence.interval else MISSING
            cells[5] = f"{(by_scene > 0).sum()} of {len(by_scene)} scenes"
            cells[6] = "; ".join(evidence.pairs["rival"].unique())
        paper = in_the_paper(claim, numbers)
        cells.append("<br>".join(f"{where}: {claim.show(value)}" for where, value in paper.items()) or MISSING)
        lines.append(f"| {' | '.join([*cells, evidence.verdict])} |")
    return "\n".join(lines)


def _pairs(claim: Claim, run_set: RunSet) -> Iterator[tuple[DataFrame, int]]:
    """Yield the advantage of each seed that both sides have, and the number of rivals, of each scene and condition.

    The longest runs that both sides have count.
    """
    runs = run_set.of_experiments(*claim.experiments)
    if claim.scenes:
        runs = runs.loc[[place.outdoor is (claim.scenes == "outdoor") for place in runs["place"]]]
    ours, others = claim.sides
    shared = ("resolution", "data", *claim.within, *(["machine"] if claim.metric in COSTS else []))
    for (place, resolution, *_), alike in grouped(runs, "place", *shared) if len(runs) else ():
        lengths = set(ours.select(alike)["length"]) & set(others.select(alike)["length"])
        both = alike.loc[alike["length"].isin(lengths)].sort_values("iterations", kind="stable", ascending=False)
        for length in dict.fromkeys(both["length"]):
            where = f"{claim.text}, {place.scene}, {resolution}, {length}"
            own = both.loc[both["length"] == length]
            refuse_mixture(own, run_set.request, where, ("protocol",))
            if made := _beside_best(claim, one_setting(ours.select(own), where), others.select(own)):
                yield made[0].assign(scene=place.label), made[1]
                break


def _beside_best(claim: Claim, ours: DataFrame, others: DataFrame) -> tuple[DataFrame, int] | None:
    """Return seed, rival and advantage over the rival with the best mean, and the number of rivals."""
    first, higher = _numbers(claim, ours), claim.measure.column.higher_is_better
    rivals = {}
    for setting in settings(others.drop(index=ours.index, errors="ignore")) if len(others) else ():
        theirs = _numbers(claim, setting.runs)
        if seeds := sorted(first.keys() & theirs.keys()):
            rivals[setting.title] = {seed: claim.advantage(first[seed], theirs[seed], higher) for seed in seeds}
    if not rivals:
        return None
    best = min(rivals, key=lambda title: sum(rivals[title].values()) / len(rivals[title]))
    rows = [{"seed": seed, "rival": best, "advantage": value} for seed, value in rivals[best].items()]
    return DataFrame(rows), len(rivals)


def _numbers(claim: Claim, runs: DataFrame) -> dict[int, float]:
    """Return seed -> number of successful runs."""
    numbers = runs.loc[runs["ok"]].reindex(columns=["seed", claim.metric]).dropna()
    return dict(zip(numbers["seed"], numbers[claim.metric].astype(float), strict=True))


RULES = f"""
`padgs report findings RUNS --out docs` makes this page from runs, for the project itself from
`reports/measured/results.jsonl`, and the claims in `reports/claims.yaml`.

An advantage is the difference of the favoured side from the best of the others with the same seed, or for costs the
ratio (×); it is positive, or above 1, where the claim is right. The longest runs of a scene that both sides have are
compared. The interval has a confidence of {CONFIDENCE:.0%} (paired t-test, `scipy.stats.ttest_rel`), corrected for the
number of rivals (Bonferroni). Its units are scenes, or the seeds of all scenes if there are fewer than {LEAST_SCENES}.

A claim *holds* if the whole interval and every scene are on its side, and *does not hold* if they are on the other.
It *depends on the scene* if scenes disagree, and is *undecided* if they agree, but the interval contains zero.

All methods train with learning rates that fit the length of a run (`train.learning_rates=run`). On `bedroom` after 6400
iterations OmniGS loses 0.55 dB by it ([table](../reports/measured/learning_rates.md)), which favours PaD-GS.
"""
