"""How much more a scene has than one view shows: rooms hide one another, and each needs Gaussians of its own."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from padgs.scene import Scene, View

POINTS, VIEWS = 10_000, 16  # at most, that are looked at, evenly of the cloud and of the training
EACH = 16  # points in a bin of directions, on average
NEAREST = 3  # point of a bin that surely is on a surface: nearer ones may float
BEHIND = 1.5  # times as far as that: behind the surface
ALONE = 1.3  # what furniture hides in one room, or trees in a court


def rooms(scene: Scene) -> float:
    """How many single rooms the points of a scene would fill; at least 1; of several it finds too few.

    A view shows a point if it is not far behind the nearest points of its direction. In a room of its own that is
    nearly all of them; what is left of it in a scene, as a mean over the training views, is the share of one view.
    """
    points = scene.points[:: max(1, -(-len(scene.points) // POINTS))].double()
    points = points[points.isfinite().all(1)]
    if len(points) == 0:
        return 1.0  # whoever needs points says so
    views = scene.train[:: -(-len(scene.train) // VIEWS)]
    seen = sum(_seen(points, view) for view in views) / len(views)
    return max(1.0, 1 / (ALONE * seen))


def _seen(points: Tensor, view: View) -> float:
    """The share of points [N, 3] that a view shows, by bins of directions of equal solid angle."""
    toward = points - view.center.to(points)
    distance = toward.norm(dim=-1)
    rows = max(6, round(math.sqrt(len(points) / EACH / 2)))  # by the cosine of the angle from the world's z axis
    height = toward[:, 2] / distance.clamp(min=torch.finfo(distance.dtype).tiny)
    row = ((height + 1) / 2 * rows).long().clamp(0, rows - 1)
    column = ((torch.atan2(toward[:, 1], toward[:, 0]) / math.pi + 1) * rows).long().clamp(0, 2 * rows - 1)
    cell = 2 * rows * row + column
    order = torch.argsort(distance)
    order = order[torch.argsort(cell[order], stable=True)]  # by cell, the nearest first
    count = torch.bincount(cell, minlength=2 * rows * rows)
    first = count.cumsum(0) - count
    surface = (first + (count - 1).clamp(0, NEAREST - 1)).clamp(max=len(points) - 1)
    limit = BEHIND * distance[order[surface]]
    return (distance <= limit[cell]).double().mean().item()
