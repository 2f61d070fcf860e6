"""Curves of sweeps: each quantity against the key that was swept, one line per scene, bars over the seeds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from pandas import DataFrame

from padgs.reports import methods
from padgs.reports.conditions import OF_A_POINT, OF_A_SWEEP, footnotes, refuse_mixture
from padgs.reports.frame import by_place, grouped
from padgs.reports.gathered import Gathered, of_a_table
from padgs.reports.measures import Measure, costs, marks, quantity
from padgs.reports.request import Request
from padgs.reports.scenes import Place
from padgs.reports.settings import Setting, is_number, settings, sort_key
from padgs.reports.tables.cells import over_seeds
from padgs.reports.tables.table import Cell
from padgs.results import BY_ITSELF

SWEPT_AT_ONCE = 2  # keys; what was run by itself and differs in more is no sweep
COSTS_SHOWN = ("gaussians", "train_seconds", "frame_ms")


@dataclass(frozen=True)
class Line:
    """One curve: a preset on a scene, and what is fixed along it where more than one key was swept."""

    place: Place
    preset: str
    fixed: str
    key: str  # dotted key along x; empty where its settings have names only
    points: tuple[tuple[Any, list[Cell]], ...]  # x, a cell for each measure of the sweep

    @property
    def title(self) -> str:
        """What tells this curve from the others."""
        return ", ".join(part for part in (self.place.label, methods.title(self.preset), self.fixed) if part)


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
    def title(self) -> str:
        """What was swept, as the command named it."""
        return "Sweep without a name" if self.name == BY_ITSELF else f"Sweep {self.name}"

    @property
    def file_name(self) -> str:
        """The name without what files should not have in theirs."""
        return f"sweep_{self.name.replace('@', '_')}"

    @property
    def numbers(self) -> DataFrame:
        """A row for each quantity of each point, all digits."""
        rows = []
        for line in self.lines:
            where = {"sweep": self.name, "dataset": line.place.dataset, "scene": line.place.label}
            where |= {"preset": line.preset, "line": line.fixed, "key": line.key}
            for x, cells in line.points:
                for measure, cell in zip(self.measures, cells, strict=True):
                    rows.append({**where, "x": x, "quantity": measure.column.title, **cell.numbers})
        return DataFrame(rows, dtype=object).rename(columns={"value": "mean"})


def sweeps(gathered: Gathered) -> list[Sweep]:
    """Each sweep in which a preset was run on a scene in more than one setting, and those made without any name; an
    experiment of a table, if asked for.

    Raises:
        ReportError: a metric that nobody knows, or results that must not stand together.
    """
    request, runs = gathered.request, gathered.asked_for
    measures = _measures(request, runs)
    known = sorted(runs["experiments"].explode().dropna().unique())
    names = [name for name in known if (request.means(name) if request.experiment else not of_a_table(name))]
    found = []
    for name in names:
        own = runs.loc[[name in of for of in runs["experiments"]]]
        lines, drawn = [], {}
        for place, there in by_place(own).items():
            curves = list(_curves(there, SWEPT_AT_ONCE if name == BY_ITSELF else None))
            if not curves:
                continue
            refuse_mixture(there, request, f"{name}, {place.title}", OF_A_SWEEP)
            drawn[place.title] = there
            for preset, fixed, key, points in curves:
                for _, setting in points:
                    refuse_mixture(setting.runs, request, f"{name}, {place.title}, {setting.title}", OF_A_POINT)
                cells = tuple((x, over_seeds(setting.runs, measures)) for x, setting in points)
                lines.append(Line(place, preset, fixed, key, cells))
        if lines:
            found.append(Sweep(name, tuple(lines), measures, tuple(footnotes(drawn, request.protocol))))
    return found


def _measures(request: Request, runs: DataFrame) -> tuple[Measure, ...]:
    if request.metrics:
        return tuple(quantity(name, request.protocol, runs) for name in request.metrics)
    usual = (*marks(request.protocol), *costs(*COSTS_SHOWN))
    return tuple(measure for measure in usual if measure.name in runs and runs[measure.name].notna().any())


def _curves(runs: DataFrame, most_keys: int | None) -> Iterator[tuple[str, str, str, list[tuple[Any, Setting]]]]:
    """Preset, what is fixed, key along x and points of each curve of a scene; none for a preset in a single setting, or
    whose settings differ in more keys than these.
    """
    for (preset, variant), own in grouped(runs, "preset", "variant"):
        found = settings(own)
        if len(found) < 2:
            continue
        keys = list(found[0].changed)
        if most_keys is not None and len(keys) > most_keys:
            continue
        numeric = [key for key in keys if all(is_number(setting.changed[key]) for setting in found)]
        if len(keys) > 2 or not numeric:
            yield preset, variant, "", [(_words(setting, keys), setting) for setting in found]
            continue
        along = numeric[0]
        others = [key for key in keys if key != along]
        for fixed in dict.fromkeys(_words(setting, others) for setting in found):
            points = [(setting.changed[along], setting) for setting in found if _words(setting, others) == fixed]
            words = ", ".join(part for part in (variant, fixed) if part)
            yield preset, words, along, sorted(points, key=lambda point: sort_key(point[0]))


def _words(setting: Setting, keys: Sequence[str]) -> str:
    return ", ".join(f"{key.rpartition('.')[2]} {setting.changed[key]}" for key in keys)
