"""What is wrong with the points that training starts from. Each is `(scene, level, random) -> scene`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from padgs.scene import Scene

FEWEST = 8  # points that are left; explicit Gaussians take their first size from their three neighbours
NEAR = 0.02  # units of the scene; closer to a camera than anything is
FAR = 10.0  # times the size of the cloud
GREY = 128
INSIDE = (0.02, 0.98)  # quantiles of the points that say how large the cloud is


def sparse(scene: Scene, share: float, random: np.random.Generator) -> Scene:
    """So many of the points are left."""
    count = min(len(scene.points), max(FEWEST, round(share * len(scene.points))))
    kept = torch.from_numpy(np.sort(random.permutation(len(scene.points))[:count]))
    return replace(scene, points=scene.points[kept], point_colors=scene.point_colors[kept])


def made_up(scene: Scene, shape: str, random: np.random.Generator) -> Scene:
    """As many grey points that know nothing of the scene: in its box, in a sphere around the cameras, or there with one
    in ten in a shell ten times as far.
    """
    low, high, center, radius = _size(scene)
    count = len(scene.points)
    if shape == "box":
        points = random.uniform(low, high, (count, 3))
    else:
        distance = radius * np.cbrt(random.random(count))
        if shape == "shell":
            distance[: count // 10] = FAR * radius
        points = center + distance[:, None] * _directions(count, random)
    return replace(
        scene, points=torch.from_numpy(points).to(scene.points), point_colors=torch.full_like(scene.point_colors, GREY)
    )


def strays(scene: Scene, share: float, random: np.random.Generator) -> Scene:
    """So many of the points are anywhere in a box ten times the size of the cloud."""
    low, high, _, _ = _size(scene)
    middle, half = (low + high) / 2, FAR * (high - low) / 2
    return _moved(scene, share, lambda count: random.uniform(middle - half, middle + half, (count, 3)), random)


def in_the_face(scene: Scene, share: float, random: np.random.Generator) -> Scene:
    """So many of the points hang right in front of a training camera."""
    centers = np.stack([view.center.cpu().numpy() for view in scene.train])

    def near(count: int) -> np.ndarray:
        distance = NEAR * scene.scale * random.uniform(0.1, 1, (count, 1))
        return centers[random.integers(len(centers), size=count)] + distance * _directions(count, random)

    return _moved(scene, share, near, random)


def _moved(scene: Scene, share: float, places, random: np.random.Generator) -> Scene:
    """The scene with that share of its points, and their colours, at other places."""
    chosen = random.permutation(len(scene.points))[: round(share * len(scene.points))]
    points = scene.points.clone()
    points[torch.from_numpy(chosen).to(points.device)] = torch.from_numpy(places(len(chosen))).to(points)
    return replace(scene, points=points)


def _size(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Corners of the box of the points between quantiles `INSIDE`, the middle of the cameras, and the radius of the
    points around it.
    """
    points = scene.points.double().cpu().numpy()
    center = np.mean([view.center.cpu().numpy() for view in scene.train], axis=0)
    radius = np.quantile(np.linalg.norm(points - center, axis=1), INSIDE[1])
    low, high = np.quantile(points, INSIDE, axis=0)
    return low, high, center, float(radius)


def _directions(count: int, random: np.random.Generator) -> np.ndarray:
    found = random.standard_normal((count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)
