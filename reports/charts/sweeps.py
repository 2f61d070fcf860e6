"""Curves of sweeps: each quantity against the key that was swept, one line per scene, bars over the seeds."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from padgs.results import Result
from reports import methods
from reports.conditions import OF_A_POINT, OF_A_SWEEP, refuse_mixture
from reports.measures import QUANTITIES, Measure, marks, quantity
from reports.request import Request, admitted
from reports.scenes import Place, at, places
from reports.settings import Setting, of_a_table, settings, sort_key
from reports.tables.cells import over_seeds
from reports.tables.footnotes import conditions
from reports.tables.table import Cell

COSTS_SHOWN = ("gaussians", "train_seconds", "frame_ms")
HEADER = ("sweep", "dataset", "scene", "preset", "line", "key", "x", "quantity", "mean", "std", "n", "status")


@dataclass(frozen=True)
class Line:
    """One curve: a preset on a scene, and what is fixed along it where more than one key was swept."""

    place: Place
    preset: str
    fixed: str
    key: str  # dotted key along x; empty where its settings have names only
    points: tuple[tuple[Any, Setting], ...]  # x, setting

    @property
    def title(self) -> str:
        """What tells this curve from the others."""
        return ", ".join(part for part in (self.place.scene, methods.title(self.preset), self.fixed) if part)


@dataclass(frozen=True)
class Sweep:
    """A sweep and its curves."""

    name: str  # tau@cpu
    lines: tuple[Line, ...]
    measures: tuple[Measure, ...]
    notes: tuple[str, ...]

    @property
    def key(self) -> str:
        """The dotted key along x, if it is the same for all curves; else empty."""
        keys = {line.key for line in self.lines}
        return keys.pop() if len(keys) == 1 else ""

    @property
    def file_name(self) -> str:
        """The name without what files should not have in theirs."""
        return f"sweep_{self.name.replace('@', '_')}"


def sweeps(results: Sequence[Result], request: Request) -> list[Sweep]:
    """Each sweep in which a preset was run on a scene in more than one setting; an experiment of a table, if asked for.

    Raises:
        ReportError: a metric that nobody knows, or results that must not stand together.
    """
    runs = admitted(results, request)
    measures = _measures(request, runs)
    found = []
    names = sorted({name for result in runs for name in result.experiments})
    for name in [request.experiment] if request.experiment else [name for name in names if not of_a_table(name)]:
        own = [result for result in runs if name in result.experiments]
        lines = [line for place in places(own) for line in _lines(place, at(place, own))]
        if not lines:
            continue
        drawn = {line.place: at(line.place, own) for line in lines}
        for place, of in drawn.items():
            refuse_mixture(of, request, f"{name}, {place.title}", OF_A_SWEEP)
        for line in lines:
            for _, setting in line.points:
                refuse_mixture(setting.runs, request, f"{name}, {line.place.title}, {setting.title}", OF_A_POINT)
        notes = conditions({place.title: of for place, of in drawn.items()}, request.protocol)
        found.append(Sweep(name, tuple(lines), measures, tuple(notes)))
    return found


def cell(setting: Setting, measure: Measure) -> Cell:
    """Mean and spread of a quantity over the seeds of a point."""
    return over_seeds(setting.runs, measure.number)


def csv_text(sweep: Sweep) -> str:
    """All points of all curves, all digits."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(HEADER)
    for line in sweep.lines:
        for x, setting in line.points:
            for measure in sweep.measures:
                number = cell(setting, measure)
                count = "" if number.value is None else number.count
                where = (sweep.name, line.place.dataset, line.place.scene, line.preset, line.fixed, line.key, x)
                writer.writerow((*where, measure.column.title, number.value, number.std, count, number.status))
    return file.getvalue()


def _measures(request: Request, results: Sequence[Result]) -> tuple[Measure, ...]:
    if request.metrics:
        return tuple(quantity(name, request.protocol, results) for name in request.metrics)
    return (*marks(request.protocol), *(QUANTITIES[name] for name in COSTS_SHOWN))


def _lines(place: Place, results: Sequence[Result]) -> Iterable[Line]:
    """The curves of one scene; none for a preset in a single setting."""
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        groups.setdefault((result.preset, result.variant), []).append(result)
    for (preset, variant), runs in groups.items():
        points = settings(runs)
        if len(points) < 2:
            continue
        keys = list(points[0].changed)
        numeric = [key for key in keys if all(_is_number(point.changed[key]) for point in points)]
        if len(keys) > 2 or not numeric:
            named = tuple((_words(point, keys), point) for point in points)
            yield Line(place, preset, variant, "", named)
            continue
        along = numeric[0]
        others = [key for key in keys if key != along]
        for fixed in dict.fromkeys(_words(point, others) for point in points):
            own = [(point.changed[along], point) for point in points if _words(point, others) == fixed]
            own.sort(key=lambda pair: sort_key(pair[0]))
            yield Line(place, preset, ", ".join(part for part in (variant, fixed) if part), along, tuple(own))


def _words(setting: Setting, keys: Sequence[str]) -> str:
    return ", ".join(f"{key.rpartition('.')[2]} {setting.changed[key]}" for key in keys)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
