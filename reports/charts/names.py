"""Names written at their marks, with a leader where there was no room beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from padgs.reports.charts.labels import BESIDE, Named, place
from padgs.reports.charts.palette import INK, SOFT

STEP = 5.0  # pixels between two points of a line that names avoid
EDGE = 2.0  # pixels that names keep from the axes' edge
WEIGHTS = {"bold": 9.0, "normal": 8.5, "faint": 7.0}  # points

Line = list[tuple[float, float]]  # corners in data coordinates


@dataclass(frozen=True)
class Name:
    """What to write at a mark: in data coordinates, with the radius of the mark in points."""

    text: str
    at: tuple[float, float]
    radius: float
    weight: str  # of `WEIGHTS`


def write(
    panel: Any,
    names: Sequence[Name],
    marks: Sequence[tuple[float, float, float]],
    lines: Sequence[Line] = (),
) -> list[Any]:
    """Write names, important ones first, where they hide least; the texts that found room.

    The layout of the figure must be fixed. Places are kept as fractions of the figure, so that all formats agree.

    Args:
        panel: axes.
        names: what to write.
        marks: x, y (data) and radius (points) of everything drawn, those of `names` included.
        lines: corners (data) of lines that names should not hide.
    """
    made, to_pixels = panel.figure, panel.transData.transform
    points = made.dpi / 72
    named, texts = [], []
    for name in names:
        soft = name.weight == "faint"
        text = made.text(
            *(0.5, 0.5),
            name.text,
            fontsize=WEIGHTS[name.weight],
            fontweight="normal" if soft else name.weight,
            color=SOFT[0] if soft else INK[0],
            linespacing=1.05,
            zorder=6,
            **{"ha": "center", "va": "center"},
        )
        box = text.get_window_extent()
        named.append(Named(tuple(to_pixels(name.at)), name.radius * points, (box.width, box.height)))
        texts.append(text)
    box = panel.get_window_extent()
    inside = (box.x0 + EDGE, box.y0 + EDGE, box.x1 - EDGE, box.y1 - EDGE)
    discs = [(*to_pixels((x, y)), radius * points) for x, y, radius in marks]
    found = place(named, inside, discs, [at for line in lines for at in _along(to_pixels(line))])
    to_figure = made.transFigure.inverted().transform
    for text, one, middle in zip(texts, named, found, strict=True):
        if middle is None:
            text.remove()
            continue
        text.set_position(to_figure(middle))
        _leader(made, one, np.array(middle))
    return [text for text, middle in zip(texts, found, strict=True) if middle is not None]


def _leader(made: Any, one: Named, middle: np.ndarray) -> None:
    from matplotlib.lines import Line2D

    half, at = np.array(one.size) / 2, np.array(one.at)
    end = np.clip(at, middle - half, middle + half)
    distance = np.linalg.norm(end - at)
    if distance - one.radius > BESIDE:
        start = at + (end - at) * one.radius / distance
        ends = made.transFigure.inverted().transform([start, end])
        made.add_artist(Line2D(*ends.T, color=SOFT[0], linewidth=0.5, zorder=5))


def _along(corners: np.ndarray) -> list[tuple[float, float]]:
    """Points along a line through corners in pixels."""
    found = []
    for start, end in zip(corners, corners[1:], strict=False):
        steps = max(int(np.linalg.norm(end - start) / STEP), 1)
        found += [tuple(start + (end - start) * step / steps) for step in range(steps + 1)]
    return found
