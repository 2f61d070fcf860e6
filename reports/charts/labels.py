"""Labels beside the marks of a chart: never on each other or outside the axes, off other marks if possible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padgs.reports.charts.drawing import INK, SOFT
from padgs.reports.methods import method_of

GAPS = (2.0, 5.0, 9.0, 14.0, 20.0, 28.0, 38.0, 50.0, 65.0, 85.0, 110.0, 140.0, 180.0)  # pixels from the mark's edge
DIRECTIONS = 24
BESIDE = 7.0  # pixels between a mark and its label; a label further away has a leader line
CLEARANCE = 1.5  # pixels around a label
ON_A_MARK = 0.8  # cost of a covered square pixel of a mark, in pixels of distance
OURS = ("padgs", "padgs_plus")  # methods with bold labels
FONT_SIZES = {"bold": 9.0, "normal": 8.5, "faint": 7.0}  # points, by weight


@dataclass(frozen=True)
class Label:
    """The text of a mark at a point in data coordinates, with the radius of the mark in points."""

    text: str
    at: tuple[float, float]
    radius: float
    weight: str  # key of `FONT_SIZES`


def write_labels(panel: Any, labels: Sequence[Label], marks: Sequence[tuple[float, float, float]]) -> list[Any]:
    """Write labels one after the other, each at its cheapest place, and return the texts that found one.

    Positions are fractions of the figure, so its layout must be fixed, and all file formats agree.

    Args:
        panel: matplotlib axes.
        labels: the important ones first.
        marks: x, y (data) and radius (points) of all marks, with and without a label.
    """
    figure, points = panel.figure, panel.figure.dpi / 72
    to_pixels, to_figure = panel.transData.transform, figure.transFigure.inverted().transform
    discs = np.array([(*to_pixels((x, y)), radius * points) for x, y, radius in marks]).reshape(-1, 3)
    squares = np.concatenate([discs[:, :2] - discs[:, 2:], discs[:, :2] + discs[:, 2:]], 1)
    inside = panel.get_window_extent().padded(-CLEARANCE)
    taken, written = np.zeros((0, 4)), []
    for label in labels:
        soft = label.weight == "faint"
        text = figure.text(0.5, 0.5, label.text, fontsize=FONT_SIZES[label.weight], color=(SOFT if soft else INK)[0])
        text.set(ha="center", va="center", linespacing=1.05, zorder=6, weight="normal" if soft else label.weight)
        extent, at, radius = text.get_window_extent(), to_pixels(label.at), label.radius * points
        boxes, costs = _candidates(at, radius, np.array([extent.width, extent.height]))
        free = (boxes[:, :2] >= inside.min).all(1) & (boxes[:, 2:] <= inside.max).all(1)
        free &= ~_overlap(boxes, taken).any(1)
        if not free.any():
            text.remove()
            continue
        boxes, costs = boxes[free], costs[free]
        box = boxes[np.argmin(costs + ON_A_MARK * _overlap(boxes, squares).sum(1))]
        taken = np.concatenate([taken, [box + np.array([-1, -1, 1, 1]) * CLEARANCE]])
        text.set_position(to_figure(box.reshape(2, 2).mean(0)))
        end = np.clip(at, box[:2], box[2:])
        if (distance := np.linalg.norm(end - at)) - radius > BESIDE:
            leader = np.stack([at + (end - at) * radius / distance, end])
            panel.plot(*panel.transData.inverted().transform(leader).T, color=SOFT[0], linewidth=0.5, zorder=1.6)
        written.append(text)
    return written


def weight_of(preset: str, role: str) -> str:
    """Return the font weight of a preset's label: bold for main presets of ours, faint for variants and releases."""
    return "faint" if role != "main" else "bold" if method_of(preset) in OURS else "normal"


def _candidates(at: NDArray, radius: float, size: NDArray) -> tuple[NDArray, NDArray]:
    """Return boxes [n, 4] (left, bottom, right, top) around a mark, and costs [n]: best near and to the upper right."""
    gaps, angles = np.repeat(GAPS, DIRECTIONS), np.tile(np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS), len(GAPS))
    direction = np.stack([np.cos(angles), np.sin(angles)], 1)
    # The middle of a box that moves around the disc of the mark without touching it.
    middles = at + (radius + gaps)[:, None] * direction + size / 2 * np.clip(1.5 * direction, -1, 1)
    return np.concatenate([middles - size / 2, middles + size / 2], 1), gaps + 2 * (2 - direction.sum(1))


def _overlap(boxes: NDArray, others: NDArray) -> NDArray:
    """Return the areas [n, m] that boxes [n, 4] share with others [m, 4]."""
    shared = np.minimum(boxes[:, None, 2:], others[:, 2:]) - np.maximum(boxes[:, None, :2], others[:, :2])
    return np.clip(shared, 0, None).prod(2)
