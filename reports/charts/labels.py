"""Where names stand beside their marks: never on another name, never outside, where they can on nothing at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

GAPS = (2.0, 5.0, 9.0, 14.0, 20.0, 28.0, 38.0, 50.0, 65.0, 85.0, 110.0, 140.0, 180.0)  # pixels from the mark's edge
DIRECTIONS = 24
ROUNDS = 6  # in which each name looks for a better place among the others
BESIDE = 7.0  # pixels between a mark and its name
CLEARANCE = 1.5  # pixels between two names, and between a name and a line
# What is worth how many pixels of distance:
ON_A_MARK = 0.8  # a square pixel of another mark, hidden
ON_A_LINE = 4.0  # a point of a line, struck through
LED = 12.0  # a leader, which a name further than `BESIDE` from its mark needs
ACROSS = 60.0  # a leader that crosses a mark or a name
ASTRAY = 10.0  # to stand nearer to another mark
BELOW_LEFT = 2.0  # not to stand right of the mark and above


@dataclass(frozen=True)
class Named:
    """A mark that wants a name; pixels, x to the right and y up."""

    at: tuple[float, float]
    radius: float
    size: tuple[float, float]  # of the name: width, height


def place(
    named: Sequence[Named],
    inside: tuple[float, float, float, float],
    marks: Sequence[tuple[float, float, float]],
    lines: Sequence[tuple[float, float]] = (),
) -> list[tuple[float, float] | None]:
    """The middle of each name in pixels; None for a name that finds no room without touching another.

    Names choose one after the other, so the important ones come first; then all look again, a few times, until none
    finds a better place. Nothing is random.

    Args:
        named: the marks with names.
        inside: left, bottom, right and top of where names may stand.
        marks: x, y and radius of everything that should not be covered, those of `named` included.
        lines: points along lines, about as dense as a letter is wide.
    """
    choices = [_candidates(one, inside, np.array(marks), np.array(lines).reshape(-1, 2)) for one in named]
    chosen: list[int | None] = [None] * len(named)
    for _ in range(ROUNDS):
        before = list(chosen)
        for index, (candidates, costs) in enumerate(choices):
            others = [choices[i][0][best] for i, best in enumerate(chosen) if i != index and best is not None]
            boxes = np.array(others).reshape(-1, 4)
            total = costs + ACROSS * _crossed(_leaders(candidates, named[index]), boxes).sum(1)
            total[_overlap(candidates, boxes, CLEARANCE).any(1)] = np.inf
            chosen[index] = int(total.argmin()) if np.isfinite(total).any() else None
        if chosen == before:
            break
    middles = [
        None if best is None else boxes[best].reshape(2, 2).mean(0)
        for best, (boxes, _) in zip(chosen, choices, strict=True)
    ]
    return [None if middle is None else (float(middle[0]), float(middle[1])) for middle in middles]


def _candidates(
    one: Named, inside: tuple[float, float, float, float], marks: NDArray, lines: NDArray
) -> tuple[NDArray, NDArray]:
    """Boxes [n, 4] as left, bottom, right, top around a mark that stay inside, and what each costs [n]."""
    (x, y), (width, height) = one.at, one.size
    angles = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    gaps = np.repeat(GAPS, DIRECTIONS)
    cos, sin = np.tile(np.cos(angles), len(GAPS)), np.tile(np.sin(angles), len(GAPS))
    # The middle of a box that moves around the mark's disc without touching it: a rectangle with round corners.
    x = x + (one.radius + gaps) * cos + width / 2 * np.clip(1.5 * cos, -1, 1)
    y = y + (one.radius + gaps) * sin + height / 2 * np.clip(1.5 * sin, -1, 1)
    boxes = np.stack([x - width / 2, y - height / 2, x + width / 2, y + height / 2], 1)
    kept = (boxes[:, :2] >= inside[:2]).all(1) & (boxes[:, 2:] <= inside[2:]).all(1)
    boxes, cost = boxes[kept], (gaps + LED * (gaps > BESIDE) + BELOW_LEFT * (2 - cos - sin))[kept]
    discs = np.stack([marks[:, 0] - marks[:, 2], marks[:, 1] - marks[:, 2], *(marks[:, :2] + marks[:, 2:]).T], 1)
    cost += ON_A_MARK * _overlap(boxes, discs).sum(1)
    struck = (lines >= boxes[:, None, :2] - CLEARANCE).all(2) & (lines <= boxes[:, None, 2:] + CLEARANCE).all(2)
    cost += ON_A_LINE * struck.sum(1)
    others = (marks[:, :2] != one.at).any(1)
    distances = np.linalg.norm(np.clip(marks[:, :2], boxes[:, None, :2], boxes[:, None, 2:]) - marks[:, :2], axis=2)
    edges = np.where(others, distances - marks[:, 2], np.inf).min(1, initial=np.inf)
    cost += ASTRAY * (edges < distances[:, ~others].min(1, initial=np.inf) - one.radius)
    return boxes, cost + ACROSS * _crossed(_leaders(boxes, one), discs[others]).sum(1)


def _overlap(boxes: NDArray, others: NDArray, clearance: float = 0.0) -> NDArray:
    """The areas [n, m] that boxes [n, 4] share with others [m, 4], which are that much larger on each side."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2] - clearance)
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:] + clearance)
    return np.clip(high - low, 0, None).prod(2)


def _leaders(boxes: NDArray, one: Named) -> NDArray:
    """Points [n, k, 2] on the way from the edge of a mark to the nearest point of each box."""
    ends = np.clip(one.at, boxes[:, :2], boxes[:, 2:])
    distance = np.linalg.norm(ends - one.at, axis=1, keepdims=True)
    starts = one.at + (ends - one.at) * np.minimum(one.radius / np.maximum(distance, 1e-9), 1)
    return starts[:, None] + (ends - starts)[:, None] * np.linspace(0.1, 0.9, 9)[:, None]


def _crossed(leaders: NDArray, boxes: NDArray) -> NDArray:
    """Which leaders [n, k, 2] pass through which boxes [m, 4]."""
    points = leaders[:, :, None]
    within = (points >= boxes[:, :2]) & (points <= boxes[:, 2:])
    return np.any(np.all(within, axis=3), axis=1)
