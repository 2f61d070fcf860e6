"""Charts of sweeps: each quantity over the key that was swept, a curve per scene and preset, bars over seeds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from pandas import DataFrame

from padgs.reports import REPORTS, methods
from padgs.reports.charts.drawing import COLORS, MARKERS, SOFT, Chart, figure, lay_out, set_axis, spans, styled
from padgs.reports.conditions import OF_A_POINT, OF_A_SWEEP, footnotes, refuse_mixture
from padgs.reports.frame import by_place, grouped
from padgs.reports.measures import COSTS, Measure, metrics, quantity
from padgs.reports.published import Place
from padgs.reports.selection import Request, RunSet, Setting, experiment_of, is_number, one_setting, settings, sort_key
from padgs.reports.significance import over_seeds
from padgs.reports.table import Cell
from padgs.results import AD_HOC

MAX_AD_HOC_KEYS = 2  # runs without an experiment that differ in more keys are no sweep
SHOWN_COSTS = ("gaussians", "train_seconds", "frame_ms")
COLUMNS = 3
LOG_RATIO = 20  # largest over smallest value, from which an axis is logarithmic
PAPER_CHOICES = {"method.tau": 0.9, "train.lambda_l1": 0.8, "method.offsets": 10, "method.features": 32}


@dataclass(frozen=True)
class Curve:
    """A preset on a scene, with the values of other swept keys."""

    place: Place
    preset: str
    fixed: str  # values of other swept keys
    key: str  # dotted key along x; empty if settings only have names
    points: tuple[tuple[Any, list[Cell]], ...]  # x, a cell for each measure of the sweep

    @property
    def named(self) -> Curve:
        """The curve with the name of its key beside each value."""
        points = ((f"{self.key.rpartition('.')[2]} {x}".strip(), cells) for x, cells in self.points)
        return replace(self, points=tuple(points))

    @property
    def title(self) -> str:
        """Scene, preset and fixed values."""
        return ", ".join(part for part in (self.place.label, methods.title(self.preset), self.fixed) if part)


@dataclass(frozen=True)
class Sweep:
    """A sweep and its curves."""

    name: str  # for example tau@cpu
    curves: tuple[Curve, ...]
    measures: tuple[Measure, ...]
    notes: tuple[str, ...]

    @property
    def key(self) -> str:
        """The dotted key along x if all curves share it, else empty."""
        keys = {curve.key for curve in self.curves}
        return keys.pop() if len(keys) == 1 else ""

    @property
    def numbers(self) -> DataFrame:
        """A row per quantity of each point, with all digits."""
        rows = []
        for curve in self.curves:
            where = {"sweep": self.name, "dataset": curve.place.dataset, "scene": curve.place.label}
            where |= {"preset": curve.preset, "line": curve.fixed, "key": curve.key}
            for x, cells in curve.points:
                for measure, cell in zip(self.measures, cells, strict=True):
                    rows.append({**where, "x": x, "quantity": measure.column.title, **cell.numbers})
        return DataFrame(rows, dtype=object).rename(columns={"value": "mean"})


def charts(run_set: RunSet) -> list[Chart]:
    """Return a chart of each sweep."""
    return [chart(sweep) for sweep in sweeps(run_set)]


def sweeps(run_set: RunSet) -> list[Sweep]:
    """Return the sweeps in which a preset was run on a scene in several settings, ad-hoc runs included.

    Experiments of tables are left out, unless the request names one.
    """
    request, runs = run_set.request, run_set.requested
    measures = _measures(request, runs)
    of_tables = {experiment for report in REPORTS.values() for experiment in report.experiments}
    known = sorted(runs["experiments"].explode().dropna().unique())
    chosen = request.matches if request.experiment else lambda name: experiment_of(name) not in of_tables
    found = []
    for name in filter(chosen, known):
        own = runs.loc[[name in of for of in runs["experiments"]]]
        curves, drawn = [], {}
        for place, there in by_place(own).items():
            if not (parts := list(_curves(there, MAX_AD_HOC_KEYS if name == AD_HOC else None))):
                continue
            refuse_mixture(there, request, f"{name}, {place.title}", OF_A_SWEEP)
            drawn[place.title] = there
            for preset, fixed, key, points in parts:
                for _, setting in points:
                    refuse_mixture(setting.runs, request, f"{name}, {place.title}, {setting.title}", OF_A_POINT)
                    one_setting(setting.runs, f"{name}, {place.title}, {setting.title}")
                cells = tuple((x, over_seeds(setting.runs, measures)) for x, setting in points)
                curves.append(Curve(place, preset, fixed, key, cells))
        if curves:
            found.append(Sweep(name, tuple(curves), measures, tuple(footnotes(drawn, request.protocol))))
    return found


@styled()
def chart(sweep: Sweep) -> Chart:
    """Return a panel for each quantity; a dotted line marks the paper's value."""
    if not sweep.key:  # several keys share an axis of texts
        sweep = replace(sweep, curves=tuple(curve.named for curve in sweep.curves))
    made, axes = figure(min(COLUMNS, len(sweep.measures)), -(-len(sweep.measures) // COLUMNS), 3.6)
    for index, (panel, measure) in enumerate(zip(axes.flat, sweep.measures, strict=False)):
        _set_axes(panel, sweep, index, measure)
        for number, curve in enumerate(sweep.curves):
            _draw(panel, curve, index, number)
    for panel in axes.flat[len(sweep.measures) :]:
        panel.set_axis_off()
    made.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    name = "without a name" if sweep.name == AD_HOC else sweep.name
    title = f"Sweep {name}: mean and standard deviation over seeds"
    title += "; dotted: the paper's value" if sweep.key in PAPER_CHOICES else ""
    lay_out(made, title)
    return Chart(f"sweep_{sweep.name.replace('@', '_')}", title, made, sweep.notes, sweep.numbers)


def _measures(request: Request, runs: DataFrame) -> tuple[Measure, ...]:
    if request.metrics:
        return tuple(quantity(name, request.protocol, runs) for name in request.metrics)
    usual = (*metrics(request.protocol), *(COSTS[name] for name in SHOWN_COSTS))
    return tuple(measure for measure in usual if measure.name in runs and runs[measure.name].notna().any())


def _curves(runs: DataFrame, max_keys: int | None) -> Iterator[tuple[str, str, str, list[tuple[Any, Setting]]]]:
    """Yield preset, fixed values, key along x and points of the curves of a scene.

    Presets in a single setting, or in settings that differ in more than `max_keys` keys, have no curve.
    """
    for (preset, variant), own in grouped(runs, "preset", "variant"):
        found = settings(own)
        keys = list(found[0].changed)
        if len(found) < 2 or (max_keys is not None and len(keys) > max_keys):
            continue
        along = next((key for key in keys if all(is_number(setting.changed[key]) for setting in found)), None)
        if len(keys) > 2 or along is None:
            yield preset, variant, "", [(", ".join(setting.words(keys)), setting) for setting in found]
            continue
        others = [key for key in keys if key != along]
        by_fixed: dict[str, list[tuple[Any, Setting]]] = {}
        for setting in found:
            words = ", ".join(filter(None, (variant, *setting.words(others))))
            by_fixed.setdefault(words, []).append((setting.changed[along], setting))
        for words, points in by_fixed.items():
            yield preset, words, along, sorted(points, key=lambda point: sort_key(point[0]))


def _set_axes(panel: Any, sweep: Sweep, index: int, measure: Measure) -> None:
    xs = [x for curve in sweep.curves for x, _ in curve.points]
    cells = [cells[index] for curve in sweep.curves for _, cells in curve.points]
    set_axis(panel.yaxis, [c.value + sign * (c.std or 0.0) for c in cells if c.value is not None for sign in (-1, 1)])
    panel.set_title(measure.column.heading, fontsize=9)
    panel.set_xlabel(sweep.key or "setting")
    if not all(isinstance(x, (int, float)) for x in xs):
        panel.tick_params(axis="x", labelrotation=20)
        return
    set_axis(panel.xaxis, xs, spans(xs, LOG_RATIO))
    if sweep.key in PAPER_CHOICES:
        panel.axvline(PAPER_CHOICES[sweep.key], color=SOFT, linestyle=":", linewidth=1)


def _draw(panel: Any, curve: Curve, index: int, number: int) -> None:
    color, marker = COLORS[number % len(COLORS)], MARKERS[number % len(MARKERS)]
    cells = [(x, cells[index]) for x, cells in curve.points]
    there = [(x, c.value, c.std or 0.0) for x, c in cells if c.value is not None]
    xs, values, stds = zip(*there, strict=True) if there else ((), (), ())
    connected = "-" if all(isinstance(x, (int, float)) for x in xs) else "none"
    panel.errorbar(xs, values, yerr=stds, color=color, linestyle="none", linewidth=1.2, capsize=2.5)
    panel.plot(xs, values, marker, color=color, markersize=5, linestyle=connected, label=curve.title)
    for x, c in cells:
        if c.status:  # at the bottom edge, on any scale
            bottom, status = panel.get_xaxis_transform(), c.status.upper()
            panel.plot([x], [0.03], "x", color=color, transform=bottom, clip_on=False)
            panel.annotate(status, (x, 0.05), xycoords=bottom, fontsize=6, color=color, ha="center")
