"""The picture of stability: a method a row, a condition a column; what is left as colour, outcomes as letters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pandas import DataFrame

from padgs.reports import methods
from padgs.reports.charts.drawing import Chart, Tips, figure, lay_out, png, styled, svg
from padgs.reports.survival import QUALITY, Stress, Survivor, in_order
from padgs.reports.tables.table import Cell

GLYPHS = {  # outcome -> its letter
    "oom": "M",
    "timeout": "T",
    "nan": "N",
    "diverged": "V",
    "collapsed": "C",
    "exploded": "E",
    "degenerate": "D",
    "silent": "S",
    "rejected": "R",
}
COLORS = "cividis"  # dark where nothing is left; even for colour-blind readers
LIGHT, DARK = "#fafafa", "#101010"  # of the numbers on dark and on bright cells
WIDTH, HEIGHT, LABELS = 0.46, 0.36, (2.3, 2.2)  # inches of a cell, and beside and above them


@styled
def chart(title: str, survivors: Sequence[Survivor]) -> Chart:
    """The heat map of a scene; the methods stand in their order."""
    stresses = in_order(survivors)
    made, axes = figure(1, 1, LABELS[0] + WIDTH * len(stresses), LABELS[1] + HEIGHT * len(survivors))
    own, tips = axes[0][0], Tips()
    rows, pictured = [], False
    for row, one in enumerate(survivors):
        for column, stress in enumerate(stresses):
            cell = one.retention.get(stress)
            if cell is not None:
                picture = _worst_picture(one.runs[stress])
                pictured = pictured or picture is not None
                _draw(own, column, row, cell, tips.add(_said(one, stress, cell)), picture)
                rows.append(
                    {"scene": title, "preset": one.preset, "condition": stress[0], "level": stress[1], **cell.numbers}
                )
    own.set_xlim(0, len(stresses))
    own.set_ylim(len(survivors), 0)
    own.set_xticks(
        [n + 0.5 for n in range(len(stresses))], [f"{name} {level}" for name, level in stresses], rotation=60, ha="left"
    )
    own.xaxis.tick_top()
    own.set_yticks(
        [n + 0.5 for n in range(len(survivors))], [methods.short(methods.title(s.preset), s.preset) for s in survivors]
    )
    own.tick_params(length=0)
    own.grid(False)
    for side in own.spines.values():
        side.set_visible(False)
    seen = {status for one in survivors for cell in one.retention.values() for status in cell.status.split()}
    letters = ", ".join(f"{letter} {status}" for status, letter in GLYPHS.items() if status in seen)
    own.set_xlabel(f"1: keeps everything, 0: one colour{f'; {letters}' if letters else ''}", fontsize=8)
    lay_out(made, f"What methods keep under stress\n{title}")
    name = f"stability-{survivors[0].place}"
    notes = ("Each cell: what is left of the distance to one colour, of the method's own without stress.",)
    if pictured:
        notes += (
            "A cell opens the picture of its worst view, truth | render | error, where the run's folder has one.",
        )
    return Chart(name, title, svg(made, name, tips), png(made), notes, DataFrame(rows))


def _worst_picture(runs: DataFrame) -> str | None:
    """Where the picture of the view with the lowest PSNR is, of all runs of a cell; None where there is none."""
    shown = [
        (psnr, path)
        for folder, psnrs in zip(runs["pictures"], runs["view_psnr"], strict=True)
        for name, psnr in psnrs.items()
        if folder is not None and (path := folder / name).is_file()
    ]
    return min(shown)[1].resolve().as_uri() if shown else None


def _draw(axes: Any, column: int, row: int, cell: Cell, tip: str, url: str | None) -> None:
    import matplotlib
    from matplotlib.patches import Rectangle

    value = cell.value or 0.0
    color = matplotlib.colormaps[COLORS](value)
    axes.add_patch(
        Rectangle((column + 0.03, row + 0.04), 0.94, 0.92, facecolor=color, edgecolor="none", gid=tip, url=url)
    )
    letters = "".join(GLYPHS[status] for status in cell.status.split())
    axes.text(
        column + 0.5,
        row + 0.5,
        letters or f"{value:.2f}".lstrip("0"),
        ha="center",
        va="center_baseline",
        fontsize=8,
        fontweight="bold" if letters else "normal",
        color=DARK if value > 0.55 else LIGHT,
        url=url,
    )


def _said(one: Survivor, stress: Stress, cell: Cell) -> str:
    """What a cell says when pointed at."""
    runs = one.runs[stress]
    parts = [f"{methods.title(one.preset)}, {stress[0]} {stress[1]}: keeps {cell.value or 0:.2f}"]
    if runs[QUALITY].notna().any():
        parts.append(f"WS-PSNR {runs[QUALITY].mean():.2f} dB, {one.rest[QUALITY].mean():.2f} without")
    return "; ".join([*parts, *([cell.status] if cell.status else [])])
