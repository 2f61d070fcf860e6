"""Speed against accuracy: a point for each method and setting of a scene, or of the scenes that all finished."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace

from padgs.results import Result
from reports import published
from reports.conditions import OF_A_CHART, OF_A_MEAN, refuse_mixture
from reports.measures import QUANTITIES, Measure, mark
from reports.metrics import column
from reports.request import Request
from reports.scenes import Place, at, places
from reports.settings import Setting, chosen, settings
from reports.tables.cells import over_scenes
from reports.tables.footnotes import conditions
from reports.tables.table import Cell

COSTS = tuple(QUANTITIES[name] for name in ("frame_ms", "train_seconds", "gaussians", "megabytes"))
QUALITIES = (("sphere", "ws_psnr"), ("sphere", "ws_lpips_alex"), ("paper", "psnr"), ("paper", "lpips_vgg_01"))
HEADER = ("chart", "setting", "preset", "quantity", "mean", "std", "n")


@dataclass(frozen=True)
class Point:
    """A method in one setting, and its numbers by the title of their column."""

    title: str
    preset: str
    numbers: dict[str, Cell]


@dataclass(frozen=True)
class TradeOff:
    """All points of one chart."""

    name: str  # of the file
    title: str
    qualities: tuple[Measure, ...]  # two: one where more is better, one where less is
    points: tuple[Point, ...]
    beside: str  # data set of the paper whose published numbers may be looked at with it
    runs: tuple[Result, ...]
    notes: tuple[str, ...]


def trade_offs(results: Sequence[Result], request: Request) -> list[TradeOff]:
    """A chart for each data set of the paper that was run, and for each other scene.

    Raises:
        ReportError: results of one chart that were not made, scored and timed alike.
    """
    runs = [result for result in chosen(results, "chart", request) if not result.variant]
    groups: dict[str, list[Place]] = {}
    for place in places(runs):
        name = place.dataset if place.published else place.scene
        if name in groups and not place.published:  # scenes of two data sets, or a scene called like a data set
            name = f"{name}_{place.dataset or 'capture'}"
        groups.setdefault(name, []).append(place)
    found = []
    for name, group in groups.items():
        shown = replace(request, protocol=_protocol([result for place in group for result in at(place, runs)]))
        for place in group:
            refuse_mixture(at(place, runs), shown, place.title, OF_A_CHART)
        made = _trade_off(name, group, runs, shown)
        if made.points:
            found.append(made)
    return found


def pareto(points: Sequence[tuple[float, float]], higher_is_better: bool) -> list[tuple[float, float]]:
    """The points (cost, quality) that no other beats in both, from cheap to dear.

    >>> pareto([(1, 20.0), (2, 19.0), (3, 25.0)], higher_is_better=True)
    [(1, 20.0), (3, 25.0)]
    """
    sign = -1 if higher_is_better else 1
    front: list[tuple[float, float]] = []
    for cost, quality in sorted(points, key=lambda point: (point[0], sign * point[1])):
        if not front or sign * quality < sign * front[-1][1]:
            front.append((cost, quality))
    return front


def csv_text(chart: TradeOff) -> str:
    """All numbers of the chart, all digits."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(HEADER)
    for point in chart.points:
        for title, cell in point.numbers.items():
            if cell.value is not None:
                writer.writerow((chart.name, point.title, point.preset, title, cell.value, cell.std, cell.count))
    return file.getvalue()


def _trade_off(name: str, group: Sequence[Place], runs: Sequence[Result], request: Request) -> TradeOff:
    by_place = [at(place, runs) for place in group]
    qualities = _qualities(request.protocol)
    found: dict[str, tuple[Setting, list[list[Result]]]] = {}
    for index, own in enumerate(by_place):
        for setting in settings(own):
            _, columns = found.setdefault(setting.title, (setting, [[] for _ in group]))
            columns[index] = list(setting.runs)
    for title, (_, columns) in found.items():
        together = [result for runs_of_scene in columns for result in runs_of_scene]
        refuse_mixture(together, request, f"{name}, {title}", OF_A_MEAN)
    found = {title: (s, c) for title, (s, c) in found.items() if any(r.ok for runs in c for r in runs)}
    finished = [i for i in range(len(group)) if all(any(r.ok for r in c[i]) for _, c in found.values())]
    if len(group) == 1:
        finished = [0]  # who failed there has no point
    points = []
    for title, (setting, columns) in found.items():
        own = [columns[i] for i in finished]
        numbers = {m.column.title: over_scenes(own, m.number) for m in (*qualities, *COSTS)}
        if any(cell.value is not None for cell in numbers.values()):
            points.append(Point(title, setting.preset, numbers))
    what = group[0].title if len(group) == 1 else published.TITLES[name]
    if len(group) > 1 or group[0].published:
        what += f", mean over its scenes {', '.join(group[i].scene for i in finished)}"
    beside = group[0].dataset if group[0].published else "ricoh360" if group[0].outdoor else "roam360"
    shown = [result for i in finished for result in by_place[i]]
    notes = conditions({what: shown}, request.protocol)
    return TradeOff(f"chart_{name}", what, qualities, tuple(points), beside, tuple(shown), tuple(notes))


def _protocol(results: Sequence[Result]) -> str:
    """The sphere's; that of the paper where nothing was scored on the sphere."""
    there = [p for p, metric in QUALITIES if any(mark(p, metric)(result) is not None for result in results)]
    return there[0] if there else "sphere"


def _qualities(protocol: str) -> tuple[Measure, ...]:
    return tuple(Measure(column(metric), mark(protocol, metric)) for of, metric in QUALITIES if of == protocol)
