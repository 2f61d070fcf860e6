"""Charts of quality over the number of Gaussians (`+experiment=capacity`), a curve for each method."""

from dataclasses import dataclass
from itertools import cycle

from pandas import DataFrame

from padgs.reports import methods
from padgs.reports.charts import drawing
from padgs.reports.charts.drawing import MARKERS, Chart, Label, color_of, set_axis, styled, weight_of
from padgs.reports.conditions import footnotes, sheets
from padgs.reports.measures import costs, metric
from padgs.reports.selection import RunSet, one_setting, settings
from padgs.reports.significance import failure_notes, over_seeds
from padgs.reports.specs import BUDGET, PREPARE
from padgs.reports.table import Cell

QUALITY = metric("sphere", "ws_psnr")
MEASURES = (QUALITY, *costs("gaussians"))
SIZE, RADIUS = (7.6, 4.8), 2.5  # inches of the chart, points of a mark


@dataclass(frozen=True)
class Point:
    """A method trained with a limit of Gaussians: how many it has when training ends, and its quality."""

    preset: str
    limit: int
    gaussians: float
    cell: Cell  # quality, with its deviation over seeds


def charts(run_set: RunSet) -> list[Chart]:
    """Return a chart for each scene, resolution and length of training with at least two limits."""
    runs, found = run_set.of_experiments("capacity"), []
    runs = PREPARE["with_budget"](runs.loc[runs["variant"] == ""])
    for name, title, own in sheets(runs, run_set.request, "capacity", ("protocol", "data", "learning_rates")):
        points = [point for preset in methods.ordered(own["preset"]) for point in _points(own, preset, title)]
        if len({point.limit for point in points}) > 1:
            notes = (*footnotes({title: own}, "sphere"), *failure_notes(settings(own)))
            found.append(_chart(name, title, points, notes))
    return found


def _points(runs: DataFrame, preset: str, where: str) -> list[Point]:
    """Return a point for each limit with which a run of a method ended well, the lowest first."""
    runs, found = runs.loc[runs["preset"] == preset], []
    for limit in sorted(runs[BUDGET].unique()):
        alike = one_setting(runs.loc[runs[BUDGET] == limit], f"{where}, {limit} Gaussians", "preset")
        quality, count = over_seeds(alike, MEASURES)
        if quality.value is not None and count.value:
            found.append(Point(preset, int(limit), count.value, quality))
    return found


@styled
def _chart(name: str, title: str, points: list[Point], notes: tuple[str, ...]) -> Chart:
    made, axes = drawing.figure(1, 1, *SIZE)
    panel, labels = axes[0, 0], []
    set_axis(panel.xaxis, [point.gaussians for point in points], logarithmic=True)
    set_axis(panel.yaxis, [point.cell.value for point in points])
    presets = list(dict.fromkeys(point.preset for point in points))
    for preset, mark in zip(presets, cycle(MARKERS), strict=False):  # presets of a method share a colour
        own = [point for point in points if point.preset == preset]
        xs, ys = [point.gaussians for point in own], [point.cell.value for point in own]
        look = {"color": color_of(preset, presets), "linewidth": 1.3, "elinewidth": 0.8}
        panel.errorbar(xs, ys, [point.cell.std or 0.0 for point in own], fmt=f"-{mark}", markersize=2 * RADIUS, **look)
        text = methods.short(methods.title(preset), preset)
        labels.append(Label(text, (xs[-1], ys[-1]), RADIUS, weight_of(preset, "main")))
    panel.set_xlabel("Gaussians when training ends")
    panel.set_ylabel(f"{QUALITY.column.title}, dB ↑")
    what = f"{title}\nquality over the number of Gaussians, trained with each limit; bars: deviation over seeds"
    drawing.lay_out(made, what)
    drawing.write_labels(panel, labels, [(point.gaussians, point.cell.value, RADIUS) for point in points])
    rows = [{**vars(point), **point.cell.numbers} for point in points]
    numbers = DataFrame(rows, columns=["preset", "limit", "gaussians", *Cell().numbers], dtype=object)
    return Chart(name, what, made, notes, numbers)
