"""Far Gaussians for what no point of the cloud stands for: the sky, and other things without texture."""

from __future__ import annotations

import math

import torch
from scipy.spatial import KDTree
from torch import Tensor

from padgs.scene import Scene
from padgs.splats.model import Splats

COUNT = 3000  # directions on the whole sphere, before those are left out that a point covers
COVERED = 2.0  # a direction is covered by a point that is nearer than so many mean distances of neighbouring directions
FARTHEST = 3.0  # times the distance that `QUANTILE` of the points are within
QUANTILE = 0.99


def with_sky(splats: Splats, scene: Scene) -> Splats:
    """The Gaussians, and a far one in each direction, seen from the middle of the cameras, that no point covers.

    They are grey until the images say more, and touch each other. A room whose cloud covers all directions gets none.
    """
    centre = torch.stack([view.center for view in scene.train]).median(0).values
    rays = scene.points.double() - centre.to(scene.points).double()
    distances = rays.norm(dim=-1)
    directions = fibonacci_sphere(COUNT).to(rays)
    spacing = math.sqrt(4 * math.pi / COUNT)
    seen = (rays / distances.clamp(min=1e-12)[:, None])[distances > 0]
    nearest, _ = KDTree(seen.cpu().numpy()).query(directions.cpu().numpy())
    free = directions[torch.from_numpy(nearest).to(directions.device) > COVERED * spacing]
    if len(free) == 0:
        return splats
    far = (
        FARTHEST * distances.quantile(QUANTILE, interpolation="nearest") if len(distances) < 2**24 else distances.max()
    )
    means = (centre.to(free) + far * free).to(splats.means)
    log_scales = torch.full_like(means, math.log(0.5 * spacing * far.item()))
    grey = torch.full_like(means, 0.5)
    sky = Splats(means, log_scales, grey, degree=splats.degree, unit=splats.unit, opacity=0.5)
    joined = Splats(means[:0], means[:0], means[:0], degree=splats.degree, unit=splats.unit)
    joined.load({name: torch.cat((own, sky.rows()[name])) for name, own in splats.rows().items()})
    return joined


def fibonacci_sphere(count: int) -> Tensor:
    """Unit vectors [count, 3] float64, spread evenly: equal steps of height, and the golden angle around."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    height = 1 - 2 * index / count
    angle = math.pi * (1 + math.sqrt(5)) * index
    radius = (1 - height * height).clamp(min=0).sqrt()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), height), dim=-1)
