"""Charts of robustness: what methods keep under stress, beside their speed and accuracy without it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from pandas import DataFrame

from padgs.reports import methods
from padgs.reports.charts.axis import set_axis
from padgs.reports.charts.drawing import INK, Chart, figure, lay_out, styled, tip
from padgs.reports.charts.labels import Label, weight_of, write_labels
from padgs.reports.robustness import QUALITY, Stress, StressedMethod, all_stress
from padgs.reports.table import MISSING, Cell

STATUS_LETTERS = {
    **{"oom": "M", "timeout": "T", "nan": "N", "diverged": "V", "collapsed": "C"},
    **{"exploded": "E", "degenerate": "D", "silent": "S", "rejected": "R"},
}
COLORS = "cividis"  # dark where nothing is left; readable for colour-blind readers
LIGHT, DARK = "#fafafa", "#101010"  # numbers on dark and on bright cells
LEVEL = 2  # of stress; 1 is mild, 3 is severe
WIDTH, HEIGHT, BORDER = 0.8, 0.34, (1.8, 1.9)  # inches of a cell, and beside and above all cells
NARROWEST, WIDEST = 5.2, 13.5  # inches of a heat map; 1500 pixels at most
AREA = 160.0  # points^2 of a mark


@styled
def heat_map(title: str, stressed: Sequence[StressedMethod]) -> Chart:
    """Return a row per condition at `LEVEL` and a column per method that was run under all of them.

    Retention is shown as colour, failures as letters. Without a run at that level, the mildest one is shown; if no
    method is complete, all are.
    """
    levels = {level for _, level in all_stress(stressed)}
    level = LEVEL if LEVEL in levels else min(levels)
    stresses = [stress for stress in all_stress(stressed) if stress[1] == level]
    complete = [one for one in stressed if not {*stresses} & one.missing]
    shown = complete or [one for one in stressed if {*stresses} & one.runs.keys()]
    width = min(WIDTH, (WIDEST - BORDER[0]) / len(shown))
    made, axes = figure(1, 1, max(BORDER[0] + width * len(shown), NARROWEST), BORDER[1] + HEIGHT * len(stresses))
    own, rows, linked = axes[0][0], [], False
    for column, one in enumerate(shown):
        for row, stress in enumerate(stresses):
            if (cell := one.robustness.get(stress)) is not None:
                url = _worst_view(one.runs[stress])
                linked = linked or url is not None
                _draw_cell(own, column, row, cell, _cell_tip(one, stress, cell), url)
                where = {"scene": title, "preset": one.preset, "condition": stress[0], "level": level}
                rows.append({**where, **cell.numbers})
    own.set_xlim(0, len(shown))
    own.set_ylim(len(stresses), 0)
    titles = [methods.short(methods.title(one.preset), one.preset) for one in shown]
    own.set_xticks([n + 0.5 for n in range(len(shown))], titles, rotation=40, ha="left")
    own.xaxis.tick_top()
    own.set_yticks([n + 0.5 for n in range(len(stresses))], [name for name, _ in stresses])
    own.tick_params(length=0)
    own.grid(False)
    own.spines[:].set_visible(False)
    seen = {
        status for one in shown for of in stresses if of in one.runs for status in one.robustness[of].status.split()
    }
    letters = ", ".join(f"{letter} {status}" for status, letter in STATUS_LETTERS.items() if status in seen)
    own.set_xlabel(f"1: keeps everything, 0: one colour{f'; {letters}' if letters else ''}")
    lay_out(made, f"What methods keep under stress of level {level}\n{title}")
    notes = ["Each cell: the distance to one colour, as a share of the method's own without stress."]
    if linked:
        notes.append("A cell opens its worst view, truth | render | error, if the folder of the run has it.")
    if left_out := [methods.title(one.preset) for one in stressed if one not in shown]:
        notes.append(f"Not run under all conditions, and so left out: {', '.join(left_out)}.")
    return Chart(f"stability-{stressed[0].place}", title, made, tuple(notes), DataFrame(rows))


@styled
def speed_and_accuracy(title: str, stressed: Sequence[StressedMethod]) -> Chart:
    """Return quality over training time without stress, with the stability score as fill, hollow if there is none."""
    import matplotlib
    from matplotlib.cm import ScalarMappable

    on_cpu = all(one.reference["cpu_seconds"].notna().all() for one in stressed)
    time, words = ("cpu_seconds", "training time on the CPU") if on_cpu else ("train_seconds", "training time")
    points = [(one.reference[time].mean(), one.reference[QUALITY].mean()) for one in stressed]
    made, axes = figure(1, 1, 5.6, 4.4)
    own, rows, labels = axes[0][0], [], []
    set_axis(own.xaxis, [cost for cost, _ in points], True)
    set_axis(own.yaxis, [quality for _, quality in points])
    own.set_xlabel(f"{words} without stress, s ↓")
    own.set_ylabel("WS-PSNR without stress, dB ↑")
    for one, (cost, quality) in zip(stressed, points, strict=True):
        name, score = methods.title(one.preset), _share(one.score)
        text = f"{name}\n{quality:.2f} dB in {cost:.1f} s; score {score}, worst quartile {_share(one.worst_quartile)}"
        color = "none" if one.score is None else matplotlib.colormaps[COLORS](one.score)
        look = {"s": AREA, "facecolors": [color], "edgecolors": INK[0], "linewidths": 0.8, "zorder": 3}
        own.scatter(cost, quality, gid=tip(text), **look)
        text = f"{methods.short(name, one.preset)}\n{score}"
        labels.append(Label(text, (cost, quality), math.sqrt(AREA) / 2, weight_of(one.preset, "main")))
        numbers = {time: cost, "ws_psnr": quality, "score": one.score, "worst_quartile": one.worst_quartile}
        rows.append({"scene": title, "preset": one.preset, **numbers})
    what = "stability score: mean of what is kept under stress ↑"
    made.colorbar(ScalarMappable(cmap=COLORS), ax=own, label=what, aspect=30)
    lay_out(made, f"Speed, accuracy and stability\n{title}")
    write_labels(own, labels, [(*label.at, label.radius) for label in labels])
    return Chart(f"robustness-{stressed[0].place}", title, made, numbers=DataFrame(rows))


def _worst_view(runs: DataFrame) -> str | None:
    """Return the address of the render with the lowest PSNR of all runs of a cell, if there is one."""
    shown = [
        (psnr, path)
        for folder, psnrs in zip(runs["renders"], runs["view_psnr"], strict=True)
        for name, psnr in psnrs.items()
        if folder is not None and (path := folder / name).is_file()
    ]
    return min(shown)[1].resolve().as_uri() if shown else None


def _draw_cell(axes: Any, column: int, row: int, cell: Cell, text: str, url: str | None) -> None:
    import matplotlib
    from matplotlib.patches import Rectangle

    value = cell.value or 0.0
    look = {"facecolor": matplotlib.colormaps[COLORS](value), "edgecolor": "none", "gid": tip(text), "url": url}
    axes.add_patch(Rectangle((column + 0.03, row + 0.04), 0.94, 0.92, **look))
    letters = "".join(STATUS_LETTERS[status] for status in cell.status.split())
    look = {"color": DARK if value > 0.55 else LIGHT, "fontweight": "bold" if letters else "normal", "url": url}
    shown, middle = letters or f"{value:.2f}".lstrip("0"), (column + 0.5, row + 0.5)
    axes.text(*middle, shown, ha="center", va="center_baseline", fontsize=10, **look)


def _cell_tip(one: StressedMethod, stress: Stress, cell: Cell) -> str:
    runs = one.runs[stress]
    parts = [f"{methods.title(one.preset)}, {stress[0]} {stress[1]}: keeps {cell.value or 0:.2f}"]
    if runs[QUALITY].notna().any():
        parts.append(f"WS-PSNR {runs[QUALITY].mean():.2f} dB, {one.reference[QUALITY].mean():.2f} without")
    return "; ".join([*parts, *([cell.status] if cell.status else [])])


def _share(value: float | None) -> str:
    return MISSING if value is None else f"{value:.2f}"
