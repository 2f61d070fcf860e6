"""Point clouds like those of structure from motion: on texture that two cameras see, with noise and outliers."""

from __future__ import annotations

import numpy as np

from padgs.data.capture import DataError
from padgs.data.synthetic.camera import center, directions
from padgs.data.synthetic.options import SyntheticOptions
from padgs.data.synthetic.textures import Array
from padgs.data.synthetic.world import SKY, World


def sample_points(
    world: World, poses: Array, images: list[Array], options: SyntheticOptions, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Sample points [P, 3] float64 in metres and their colours [P, 3] uint8.

    Pixels are drawn with a probability proportional to solid angle times local contrast, because features are found at
    texture; their exact surface points are kept if a second, random view sees them too. `poses` [n, 4, 4] and `images`,
    n times [H, W, 3] uint8, are those of the training views.
    """
    outliers = round(options.outliers * options.points)
    wanted = options.points - outliers
    chance = [_contrast(image) for image in images]
    kept, colors, found = [], [], 0
    for _round in range(20):
        batch = max(256, int(1.5 * (wanted - found) / len(poses)) + 1)
        for k in rng.permutation(len(poses)):
            points, color = _seen_twice(world, poses, int(k), images[k], chance[k], batch, options.point_noise, rng)
            kept.append(points)
            colors.append(color)
            found += len(points)
        if found >= wanted:
            break
    if not found:
        raise DataError("no surface point is seen by two cameras; choose another scene or path")
    points, color = np.concatenate(kept), np.concatenate(colors)
    choice = rng.permutation(found)[:wanted]
    points, color = points[choice], color[choice]
    low, high = np.quantile(points, 0.02, axis=0), np.quantile(points, 0.98, axis=0)
    stray = rng.uniform(low - (high - low) / 2, high + (high - low) / 2, (outliers, 3))
    return np.concatenate((points, stray)), np.concatenate((color, rng.integers(0, 256, (outliers, 3), np.uint8)))


def _contrast(image: Array) -> Array:
    """Return the probability [H * W] of a feature at each pixel: solid angle x gradient magnitude."""
    gray = image.astype(np.float32).mean(-1)
    across = np.roll(gray, -1, 1) - np.roll(gray, 1, 1)
    down = np.gradient(gray, axis=0) * 2
    height = len(gray)
    weight = np.cos(((np.arange(height) + 0.5) / height - 0.5) * np.pi)[:, None]
    # Pixels are narrower near the poles: the same contrast there is a steeper edge, but fewer features.
    chance = (np.hypot(across, down) + 1e-3) * weight
    return (chance / chance.sum()).ravel()


def _seen_twice(
    world: World,
    poses: Array,
    view: int,
    image: Array,
    chance: Array,
    count: int,
    noise: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    height, width = image.shape[:2]
    pixel = np.searchsorted(np.cumsum(chance), rng.random(count)).clip(max=height * width - 1)
    rows, columns = np.divmod(pixel, width)
    rays = poses[view, :3, :3].T @ directions(rows + 0.5, columns + 0.5, width, height)
    start = center(poses[view])[:, None]
    distance, object_id = world.nearest(start, rays)
    hit = object_id != SKY
    distance, pixel = distance[hit], pixel[hit]
    points = start + distance * rays[:, hit]
    others = np.stack([center(pose) for pose in poses])
    second = (view + rng.integers(1, len(poses), points.shape[1])) % len(poses)
    toward = points - others[second].T
    far = np.linalg.norm(toward, axis=0)
    reached, _ = world.nearest(others[second].T, toward / far)
    visible = reached > far * (1 - 1e-4) - 1e-3
    points, distance, pixel = points[:, visible], distance[visible], pixel[visible]
    noisy = points + noise * distance * rng.standard_normal(points.shape)
    return noisy.T, image.reshape(-1, 3)[pixel]
