"""Labels beside the marks of a chart: never on each other or outside the axes, off marks and lines if possible."""

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
STEP = 5.0  # pixels between two points of a line that labels avoid
OURS = ("padgs", "padgs_plus")  # methods with bold labels
FONT_SIZES = {"bold": 9.0, "normal": 8.5, "faint": 7.0}  # points, by weight
# Costs in pixels of distance:
ON_A_MARK, ON_A_LINE = 0.8, 4.0  # a covered square pixel of another mark; a covered point of a line
LEADER, CROSSING = 12.0, 60.0  # a leader line; a leader line across a mark or a label
NEARER_TO_ANOTHER, BELOW_LEFT = 10.0, 2.0  # nearer to another mark; not to the right and above

Line = Sequence[tuple[float, float]]  # corners in data coordinates


@dataclass(frozen=True)
class Label:
    """The text of a mark at a point in data coordinates, with the radius of the mark in points."""

    text: str
    at: tuple[float, float]
    radius: float
    weight: str  # key of `FONT_SIZES`


def write_labels(
    panel: Any, labels: Sequence[Label], marks: Sequence[tuple[float, float, float]], lines: Sequence[Line] = ()
) -> list[Any]:
    """Write labels one after the other, each at its cheapest place, and return the texts that found one.

    Positions are fractions of the figure, so its layout must be fixed, and all file formats agree.

    Args:
        panel: matplotlib axes.
        labels: the important ones first.
        marks: x, y (data) and radius (points) of all marks, with and without a label.
        lines: lines that labels should not cover.
    """
    figure, points = panel.figure, panel.figure.dpi / 72
    to_pixels, to_figure = panel.transData.transform, figure.transFigure.inverted().transform
    discs = np.array([(*to_pixels((x, y)), radius * points) for x, y, radius in marks])
    avoided = np.concatenate([np.zeros((0, 2)), *(_along(to_pixels(line)) for line in lines)])
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
        boxes, costs = boxes[free], costs[free]
        if not len(boxes):
            text.remove()
            continue
        starts, ends = _leaders(boxes, at, radius)
        costs = costs + _obstruction(boxes, starts, ends, discs, at, taken) + ON_A_LINE * _covered(boxes, avoided)
        best = int(costs.argmin())
        taken = np.concatenate([taken, boxes[best : best + 1] + np.array([-1, -1, 1, 1]) * CLEARANCE])
        text.set_position(to_figure(boxes[best].reshape(2, 2).mean(0)))
        if np.linalg.norm(ends[best] - starts[best]) > BESIDE:
            leader = np.stack([starts[best], ends[best]])
            avoided = np.concatenate([avoided, _along(leader)])
            panel.plot(*panel.transData.inverted().transform(leader).T, color=SOFT[0], linewidth=0.5, zorder=1.6)
        written.append(text)
    return written


def weight_of(preset: str, role: str) -> str:
    """Return the font weight of a preset's label: bold for main presets of ours, faint for variants and releases."""
    return "faint" if role != "main" else "bold" if method_of(preset) in OURS else "normal"


def _candidates(at: NDArray, radius: float, size: NDArray) -> tuple[NDArray, NDArray]:
    """Return boxes [n, 4] (left, bottom, right, top) around a mark, and the costs [n] of their distances."""
    gaps, angles = np.repeat(GAPS, DIRECTIONS), np.tile(np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS), len(GAPS))
    direction = np.stack([np.cos(angles), np.sin(angles)], 1)
    # The middle of a box that moves around the disc of the mark without touching it.
    middles = at + (radius + gaps)[:, None] * direction + size / 2 * np.clip(1.5 * direction, -1, 1)
    boxes = np.concatenate([middles - size / 2, middles + size / 2], 1)
    return boxes, gaps + LEADER * (gaps > BESIDE) + BELOW_LEFT * (2 - direction.sum(1))


def _leaders(boxes: NDArray, at: NDArray, radius: float) -> tuple[NDArray, NDArray]:
    """Return the starts [n, 2] at the edge of a mark and the ends [n, 2] of the shortest lines to the boxes."""
    ends = np.clip(at, boxes[:, :2], boxes[:, 2:])
    distance = np.linalg.norm(ends - at, axis=1, keepdims=True)
    return at + (ends - at) * np.minimum(radius / np.maximum(distance, 1e-9), 1), ends


def _obstruction(
    boxes: NDArray, starts: NDArray, ends: NDArray, discs: NDArray, at: NDArray, taken: NDArray
) -> NDArray:
    """Return the costs [n] of covering other marks, of standing nearer to another, and of leaders across them."""
    others = discs[(discs[:, :2] != at).any(1)]
    squares = np.concatenate([others[:, :2] - others[:, 2:], others[:, :2] + others[:, 2:]], 1)
    gaps = np.clip(others[:, :2], boxes[:, None, :2], boxes[:, None, 2:]) - others[:, :2]
    nearest = (np.linalg.norm(gaps, axis=2) - others[:, 2]).min(1, initial=np.inf)
    on_leaders = starts[:, None] + (ends - starts)[:, None] * np.linspace(0.1, 0.9, 9)[:, None]
    obstacles = np.concatenate([squares, taken])
    through = (on_leaders[:, :, None] >= obstacles[:, :2]) & (on_leaders[:, :, None] <= obstacles[:, 2:])
    costs = ON_A_MARK * _overlap(boxes, squares).sum(1) + CROSSING * np.any(np.all(through, axis=3), axis=1).sum(1)
    return costs + NEARER_TO_ANOTHER * (nearest < np.linalg.norm(ends - starts, axis=1))


def _overlap(boxes: NDArray, others: NDArray) -> NDArray:
    """Return the areas [n, m] that boxes [n, 4] share with others [m, 4]."""
    shared = np.minimum(boxes[:, None, 2:], others[:, 2:]) - np.maximum(boxes[:, None, :2], others[:, :2])
    return np.clip(shared, 0, None).prod(2)


def _covered(boxes: NDArray, points: NDArray) -> NDArray:
    """Return how many points [m, 2] each box [n, 4] covers [n]."""
    return ((points >= boxes[:, None, :2] - CLEARANCE) & (points <= boxes[:, None, 2:] + CLEARANCE)).all(2).sum(1)


def _along(corners: NDArray) -> NDArray:
    """Return points [n, 2] at most `STEP` apart on a line through corners [m, 2]."""
    steps = np.linalg.norm(np.diff(corners, axis=0), axis=1) / STEP
    counts = np.maximum(steps.astype(int), 1)
    pieces = [np.linspace(a, b, count + 1) for a, b, count in zip(corners, corners[1:], counts, strict=False)]
    return np.concatenate(pieces) if pieces else np.zeros((0, 2))
