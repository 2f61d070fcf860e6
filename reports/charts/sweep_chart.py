"""The picture of a sweep."""

from __future__ import annotations

from typing import Any

from padgs.reports.charts.drawing import MARKERS, Chart, Tips, dress, figure, lay_out, png, styled, svg
from padgs.reports.charts.palette import COLORS, SOFT
from padgs.reports.charts.sweeps import Line, Sweep, sweeps
from padgs.reports.gathered import Gathered
from padgs.reports.measures import Measure

COLUMNS = 3
LOGARITHMIC = 20  # from this ratio of the largest to the smallest value on
PAPER_CHOICES = {"method.tau": 0.9, "train.lambda_l1": 0.8, "method.offsets": 10, "method.features": 32}


def charts(gathered: Gathered) -> list[Chart]:
    """A picture of each sweep."""
    return [chart(sweep) for sweep in sweeps(gathered)]


@styled
def chart(sweep: Sweep) -> Chart:
    """A panel for each quantity; the dotted line is the paper's choice."""
    rows = -(-len(sweep.measures) // COLUMNS)
    made, axes = figure(min(COLUMNS, len(sweep.measures)), rows, 3.6)
    tips = Tips()
    for index, (panel, measure) in enumerate(zip(axes.flat, sweep.measures, strict=False)):
        for number, line in enumerate(sweep.lines):
            _draw(panel, line, index, measure, number, tips)
        _dress(panel, sweep, index, measure)
    for panel in axes.flat[len(sweep.measures) :]:
        panel.set_axis_off()
    handles, labels = axes[0, 0].get_legend_handles_labels()
    if handles:
        made.legend(handles, labels, loc="outside lower center", ncols=3)
    title = f"{sweep.title}: mean and standard deviation over seeds"
    lay_out(made, title)
    return Chart(sweep.file_name, title, svg(made, sweep.file_name, tips), png(made), sweep.notes, sweep.numbers)


def _draw(panel: Any, line: Line, index: int, measure: Measure, number: int, tips: Tips) -> None:
    color = COLORS[number % len(COLORS)]
    cells = [(x, cells[index]) for x, cells in line.points]
    there = [(x, c) for x, c in cells if c.value is not None]
    xs, values = [x for x, _ in there], [c.value for _, c in there]
    connected = "-" if all(isinstance(x, (int, float)) for x in xs) else ""
    panel.errorbar(
        xs, values, yerr=[c.std or 0.0 for _, c in there], color=color, linestyle=connected, linewidth=1.2, capsize=2.5
    )
    for x, c in there:
        text = f"{line.title}\n{x}: {c.text(measure.column)}"
        panel.plot([x], [c.value], MARKERS[number % len(MARKERS)], color=color, markersize=5, gid=tips.add(text))
    panel.plot([], [], MARKERS[number % len(MARKERS)], color=color, linestyle=connected or "none", label=line.title)
    for x, c in cells:
        if c.status:  # at the bottom edge, whatever the scale
            failed = panel.get_xaxis_transform()
            tip = tips.add(f"{line.title}\n{x}: {c.status.upper()}")
            panel.plot([x], [0.03], "x", color=color, transform=failed, clip_on=False, gid=tip)
            panel.annotate(c.status.upper(), (x, 0.05), xycoords=failed, fontsize=6, color=color, ha="center")


def _dress(panel: Any, sweep: Sweep, index: int, measure: Measure) -> None:
    xs = [x for line in sweep.lines for x, _ in line.points]
    values = [value for line in sweep.lines for _, cells in line.points if (value := cells[index].value) is not None]
    dress(panel.yaxis, values)
    panel.set_title(measure.column.heading, fontsize=9)
    panel.set_xlabel(sweep.key or "setting")
    if not all(isinstance(x, (int, float)) for x in xs):
        panel.tick_params(axis="x", labelrotation=20)
        return
    dress(panel.xaxis, xs, log_from=LOGARITHMIC)
    if sweep.key in PAPER_CHOICES:
        panel.axvline(PAPER_CHOICES[sweep.key], color=SOFT[0], linestyle=":", linewidth=1)
