"""Speed against accuracy: a point per method and setting of a scene, or mean over finished scenes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import pandas as pd
from pandas import DataFrame

from padgs.files import file_name
from padgs.reports import methods, published
from padgs.reports.conditions import OF_A_CHART, OF_A_MEAN, footnotes, refuse_mixture, sheets
from padgs.reports.frame import by_place, without_data
from padgs.reports.measures import COSTS, PROTOCOL_METRICS, Measure, metric
from padgs.reports.published import Place
from padgs.reports.selection import Request, RunSet, one_setting, settings
from padgs.reports.significance import failures, over_scenes
from padgs.reports.table import Cell

FEWEST = 3  # methods in a chart of equal time
SHOWN_COSTS = [COSTS[name] for name in ("frame_ms", "train_seconds", "cpu_seconds", "gaussians", "megabytes")]
QUALITIES = tuple(metric(of, PROTOCOL_METRICS[of][name]) for of in ("sphere", "paper") for name in ("psnr", "lpips"))


@dataclass(frozen=True)
class Point:
    """A setting of a preset and its numbers."""

    title: str
    preset: str
    numbers: dict[str, Cell]  # title of a column -> number

    def value(self, measure: Measure) -> float | None:
        """Return a finite number, or None."""
        value = self.numbers[measure.column.title].value
        return value if value is not None and math.isfinite(value) else None


@dataclass(frozen=True)
class TradeOff:
    """All points of one chart."""

    name: str  # file name without extension
    title: str
    quality: Measure
    points: tuple[Point, ...]
    runs: DataFrame
    notes: tuple[str, ...]

    def role(self, preset: str) -> str:
        """Return "release" for a released program with its deviations, "main" for the preset that stands for its method
        (it has the method's name, or is the first), else "variant".
        """
        if _is_release(preset):
            return "release"
        method = methods.method_of(preset)
        kin = [p.preset for p in self.points if methods.method_of(p.preset) == method and not _is_release(p.preset)]
        return "main" if preset == (method if method in kin else [*kin, preset][0]) else "variant"

    @property
    def on_cpu(self) -> bool:
        """True if CPU time is shown, which other programs disturb less: all runs have it, and none used a GPU."""
        own = self.runs.loc[self.runs["ok"] & ~self.runs["preset"].str.startswith(methods.EXTERNAL)]
        return bool(own["cpu_seconds"].notna().all() and own["peak_gpu_gigabytes"].isna().all())

    @property
    def numbers(self) -> DataFrame:
        """A row per number of each point, with all digits."""
        rows = [
            {"chart": self.name, "setting": point.title, "preset": point.preset, "quantity": title, **cell.numbers}
            for point in self.points
            for title, cell in point.numbers.items()
            if cell.value is not None
        ]
        return DataFrame(rows, dtype=object).rename(columns={"value": "mean"})


def trade_offs(run_set: RunSet) -> list[TradeOff]:
    """Return a chart for each data set of the paper and for each other scene; warn where no scene is complete."""
    runs = run_set.chosen("chart")
    groups: dict[str, dict[Place, DataFrame]] = {}
    for place, own in by_place(runs.loc[runs["variant"] == ""]).items():
        name = place.dataset if place.published and not place.apart else place.label
        if name in groups and not place.published:  # two scenes, or a scene and a data set, of one name
            name = f"{name}_{place.dataset or 'capture'}"
        groups.setdefault(name, {})[place] = own
    found, warnings = [], []
    for name, group in groups.items():
        shown = replace(run_set.request, protocol=_protocol(pd.concat(group.values())))
        for place, own in group.items():
            refuse_mixture(own, shown, place.title, OF_A_CHART)
        made = _trade_off(name, group, shown)
        if made.points:
            found.append(made)
        elif len(group) > 1:
            warnings.append(f"{made.name}: no scene was finished in all settings, so there is no mean; --where chooses")
    run_set.warnings.extend(warnings)  # after the loop, as a Mixture calls this function again
    return found


def equal_times(run_set: RunSet) -> list[TradeOff]:
    """Return a chart for each scene, resolution and time of `+experiment=equal_time` with at least `FEWEST` methods.

    Means over the scenes of a resolution and time come first, of those not tuned on, those tuned on, and all others.
    """
    runs, found = run_set.of_experiments("equal_time"), []
    shown = replace(run_set.request, protocol=_protocol(runs))
    groups: dict[tuple[str, ...], dict[Place, DataFrame]] = {}
    for name, title, own in sheets(runs.loc[runs["variant"] == ""], shown, "equal_time", OF_A_CHART):
        place, *kind = own.iloc[0][["place", "resolution", "length"]]
        made = _trade_off("equal_time", {place: own}, shown)
        if len({point.preset for point in made.points}) >= FEWEST:
            found.append(replace(made, name=name, title=title))
            groups.setdefault((place.seen, *kind), {})[place] = without_data(own)
    means = []
    for (seen, size, length), group in groups.items():
        made = _trade_off("equal_time", group, shown)
        if len(group) > 1 and not made.points:
            run_set.warnings.append(f"{size}, {length}: no scene was finished in all settings, so there is no mean")
        elif len(group) > 1:
            title = f"{made.title}{f' ({seen})' if seen else ''}, {size}, {length}"
            name = "_".join(filter(None, ("equal_time_mean", seen, size, length)))
            means.append(replace(made, name=file_name(name), title=title))
    return [*means, *found]


def pareto(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the points (cost, quality, more is better) that no other point beats in both, by rising cost."""
    front: list[tuple[float, float]] = []
    for cost, quality in sorted(points, key=lambda point: (point[0], -point[1])):
        if not front or quality > front[-1][1]:
            front.append((cost, quality))
    return front


def _is_release(preset: str) -> bool:
    return methods.published_as(preset) != preset


def _trade_off(name: str, group: Mapping[Place, DataFrame], request: Request) -> TradeOff:
    measures = (*(measure for measure in QUALITIES if measure.name.startswith(f"{request.protocol}/")), *SHOWN_COSTS)
    every = settings(pd.concat(group.values()))
    for setting in every:
        refuse_mixture(setting.runs, request, f"{name}, {setting.title}", OF_A_MEAN)
        for place, own in by_place(setting.runs).items():
            one_setting(own, f"{place.title}, {setting.title}")
    found = [setting for setting in every if setting.runs["ok"].any()]  # a setting that failed has no point
    finished = [p for p in group if all((one.runs["ok"] & (one.runs["place"] == p)).any() for one in found)]
    first, points = next(iter(group)), list[Point]()
    for setting in found if finished else ():
        cells = over_scenes(setting.runs, finished, measures)
        if any(cell.value is not None for cell in cells):
            titles = [measure.column.title for measure in measures]
            points.append(Point(setting.title, setting.preset, dict(zip(titles, cells, strict=True))))
    what = first.title if len(group) == 1 else published.TITLES.get(name, "")
    if len(group) > 1 or first.published:
        named = ", ".join(place.scene for place in finished)
        what = f"{what}, mean over its scenes {named}" if what else f"mean over {named}"
    shown = pd.concat([group[place] for place in finished]) if finished else group[first].iloc[:0]
    failed = [f"{one.title} ({words.upper()})" for one in every if (words := failures(one.runs))]
    notes = footnotes({what: shown}, request.protocol)
    notes += [f"Failed runs are left out: {'; '.join(failed)}."] if failed else []
    return TradeOff(f"chart_{name}", what, measures[0], tuple(points), shown, tuple(notes))


def _protocol(runs: DataFrame) -> str:
    """Return "sphere", or "paper" if no run was scored on the sphere."""
    known = (of.name for of in QUALITIES if of.name in runs and runs[of.name].notna().any())
    return next(known, "sphere").partition("/")[0]
