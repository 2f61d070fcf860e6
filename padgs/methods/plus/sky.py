"""Far Gaussians for what no point of the cloud stands for: the sky, and other things without texture."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from padgs.methods.splats.model import Splats
from padgs.scene import Scene

# A point covers directions nearer than so many spacings of directions, or of the points if those are wider.
COVERED = 2.0
FARTHEST = 3.0  # times the distance that `QUANTILE` of the points are within
QUANTILE = 0.99


def far_gaussians(scene: Scene, count: int, *, degree: int, opacity: float) -> Splats:
    """A far Gaussian in each of `count` even directions, seen from the middle of the cameras, that no point covers.

    They are grey until the images say more, and touch each other. A room whose cloud covers all directions gets none.
    """
    from scipy.spatial import KDTree

    centre = torch.stack([view.center for view in scene.train]).median(0).values
    rays = scene.points.double() - centre.to(scene.points).double()
    distances = rays.norm(dim=-1)
    seen = (rays / distances[:, None])[distances > 0]
    spacing = math.sqrt(4 * math.pi / count)
    reach = COVERED * max(spacing, math.sqrt(4 * math.pi / len(seen)))
    directions = fibonacci_sphere(count)
    nearest, _ = KDTree(seen.cpu().numpy()).query(directions.numpy(), distance_upper_bound=reach)
    free = directions[torch.from_numpy(nearest).isinf()].to(rays)
    far = FARTHEST * distances[:: max(1, len(distances) // 20_000)].quantile(QUANTILE).item()
    means = (centre.to(free) + far * free).to(scene.points)
    log_scales = torch.full_like(means, math.log(0.5 * spacing * far))
    grey = torch.full_like(means, 0.5)
    return Splats(means, log_scales, grey, degree=degree, unit=scene.scale, opacity=opacity)


def fibonacci_sphere(count: int) -> Tensor:
    """Unit vectors [count, 3] float64, spread evenly: equal steps of height, and the golden angle around."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    height = 1 - 2 * index / count
    angle = math.pi * (1 + math.sqrt(5)) * index
    radius = (1 - height * height).clamp(min=0).sqrt()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), height), dim=-1)
