"""Speed against accuracy: a point for each method and setting of a scene, or of the scenes that all finished."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

from padgs.results import Result
from reports import published
from reports.cells import over_scenes
from reports.conditions import OF_A_CHART, refuse_mixture
from reports.footnotes import conditions
from reports.measures import QUANTITIES, Measure, mark
from reports.metrics import column
from reports.request import Request
from reports.scenes import Place, at, places
from reports.settings import Setting, chosen, settings
from reports.table import Cell

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
        groups.setdefault(place.dataset if place.published else place.scene, []).append(place)
    found = []
    for name, group in groups.items():
        for place in group:
            refuse_mixture(at(place, runs), request, place.title, OF_A_CHART)
        made = _trade_off(name, group, runs, request)
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
    qualities = _qualities([result for own in by_place for result in own])
    found: dict[str, tuple[Setting, list[list[Result]]]] = {}
    for index, own in enumerate(by_place):
        for setting in settings(own):
            _, columns = found.setdefault(setting.title, (setting, [[] for _ in group]))
            columns[index] = list(setting.runs)
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
    notes = conditions({what: shown}, next(p for p, m in QUALITIES if column(m) == qualities[0].column))
    return TradeOff(f"chart_{name}", what, qualities, tuple(points), beside, tuple(shown), tuple(notes))


def _qualities(results: Sequence[Result]) -> tuple[Measure, ...]:
    """WS-PSNR and weighted LPIPS; the flat ones where nothing was scored on the sphere."""
    measures = [(Measure(column(metric), mark(protocol, metric)), protocol) for protocol, metric in QUALITIES]
    there = [protocol for measure, protocol in measures if any(measure.number(r) is not None for r in results)]
    protocol = there[0] if there else "sphere"
    return tuple(measure for measure, of in measures if of == protocol)
