"""Ray casting: panoramas with supersampled colour, exact depth and object ids, dual-fisheye cameras, and point clouds.

Poses are in metres. The sub-pixel jitter of a pixel depends on its row only: rotating the camera by whole pixels about
the vertical shifts the image exactly.
"""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from padgs.clock import cores
from padgs.data.capture import DataError
from padgs.data.synthetic.options import SyntheticOptions
from padgs.data.synthetic.textures import Array
from padgs.data.synthetic.world import SKY, World
from padgs.geometry.lens import axis_direction, bend, hemisphere_weight
from padgs.geometry.panorama import rays

_BLOCK = (32, 64)  # pixels; rays of a block share a list of candidate shapes, and fit into the processor cache


def directions(rows: Array, columns: Array, width: int, height: int) -> Array:
    """Return unit camera-frame directions [3, n] through continuous pixel positions u = columns [n], v = rows [n]."""
    longitude = (columns / width - 0.5) * (2 * math.pi)
    latitude = (rows / height - 0.5) * math.pi
    flat = np.cos(latitude)
    return np.stack((flat * np.sin(longitude), np.sin(latitude), flat * np.cos(longitude)))


def draw(
    world: World, pose: Array, width: int, samples: int, seed: int = 0, lens: Callable[[Array], Array] | None = None
) -> Array:
    """Render the panorama [H, W, 3] uint8 of a camera at a cam_from_world pose [4, 4], `samples` rays per pixel.

    `lens` maps the camera-frame directions [3, n] of an ideal panorama to those of the rays.
    """
    height = width // 2
    image = np.empty((height, width, 3), np.uint8)
    jitter = _jitter(height, samples, seed)
    world_from_cam = pose[:3, :3].T.astype(np.float32)
    origin = center(pose)[:, None].astype(np.float32)
    blocks = [(i, j) for i in range(0, height, _BLOCK[0]) for j in range(0, width, _BLOCK[1])]

    def fill(block: tuple[int, int]) -> None:
        rows = np.arange(block[0], min(block[0] + _BLOCK[0], height))
        columns = np.arange(block[1], min(block[1] + _BLOCK[1], width))
        v = np.broadcast_to((rows[:, None] + jitter[rows, :, 1])[:, None, :], (len(rows), len(columns), samples))
        u = columns[None, :, None] + jitter[rows, :, 0][:, None, :]
        rays = directions(v.ravel().astype(np.float32), u.ravel().astype(np.float32), width, height)
        color = world.color(origin, world_from_cam @ (rays if lens is None else lens(rays)))
        mean = color.reshape(3, len(rows), len(columns), samples).mean(-1)
        image[np.ix_(rows, columns)] = np.clip(mean * 255 + 0.5, 0, 255).astype(np.uint8).transpose(1, 2, 0)

    _ = world.light_maps  # baked once, before the threads
    with ThreadPoolExecutor(min(8, cores())) as pool:  # numpy releases the interpreter lock
        list(pool.map(fill, blocks))
    return image


def trace(world: World, cam_from_world: Array, width: int) -> tuple[Array, Array]:
    """Return exact distances [H, W] float64 in metres (inf = sky) and object ids [H, W] (-1 = sky) at pixel centres."""
    height = width // 2
    rows, columns = np.indices((height, width)) + 0.5
    world_rays = cam_from_world[:3, :3].T @ directions(rows.ravel(), columns.ravel(), width, height)
    distance, object_id = world.nearest(center(cam_from_world)[:, None], world_rays)
    return distance.reshape(height, width), object_id.reshape(height, width)


def center(cam_from_world: Array) -> Array:
    """Return the camera centre [3] of a pose [4, 4]."""
    return -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]


def _jitter(height: int, samples: int, seed: int) -> Array:
    """Return stratified positions [H, samples, 2] within a pixel, one per cell of a square grid."""
    side = math.isqrt(samples)
    cell = np.stack(np.divmod(np.arange(samples), side)[::-1], axis=-1)
    return (cell + np.random.default_rng((seed, 0x5EED)).random((height, samples, 2))) / side


def draw_stitched(world: World, cam_from_world: Array, gap: float, options: SyntheticOptions) -> Array:
    """Render the panorama [H, W, 3] uint8 of two fisheye lenses `gap` metres apart, centred between them.

    Rays of each lens are exact; stitching ignores the gap and the radial distortion, so that the image has parallax and
    a kink at the plane between the lenses. The front lens looks along the camera's z.
    """
    axis, coefficients = axis_direction("z"), torch.tensor([options.lens_k1], dtype=torch.float64)
    images = []
    for sign in (1.0, -1.0):
        pose = cam_from_world.copy()
        pose[:3, 3] -= sign * 0.5 * gap * axis.numpy()

        def distorted(directions: Array, axis: torch.Tensor = sign * axis) -> Array:
            bent = bend(torch.from_numpy(directions).double().T, axis, coefficients)
            return bent.T.to(torch.float32).numpy()

        images.append(draw(world, pose, options.width, options.samples, options.seed, distorted))
    directions = rays(options.width, options.height, dtype=torch.float64)
    weight = hemisphere_weight(directions, axis, math.radians(options.lens_blend)).numpy()[..., None]
    return np.round(weight * images[0] + (1 - weight) * images[1]).astype(np.uint8)


def sample_points(
    world: World, poses: Array, images: list[Array], options: SyntheticOptions, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Sample points [P, 3] float64 in metres and their colours [P, 3] uint8, like those of structure from motion.

    Pixels are drawn with a probability proportional to solid angle times local contrast, because features are found at
    texture; their exact surface points are kept if a second, random view sees them too, and get noise. `poses`
    [n, 4, 4] and `images`, n times [H, W, 3] uint8, are those of the training views.
    """
    outliers = round(options.outliers * options.points)
    wanted = options.points - outliers
    chance = [_cumulative_contrast(image) for image in images]
    kept, colors, found = [], [], 0
    for _round in range(20):
        batch = max(256, int(1.5 * (wanted - found) / len(poses)) + 1)
        for k in rng.permutation(len(poses)):
            pixel = np.searchsorted(chance[k], rng.random(batch)).clip(max=len(chance[k]) - 1)
            points, distance, pixel = _seen_twice(world, poses, k, pixel, options.width, rng)
            kept.append((points + options.point_noise * distance * rng.standard_normal(points.shape)).T)
            colors.append(images[k].reshape(-1, 3)[pixel])
            found += len(pixel)
        if found >= wanted:
            break
    if not found:
        raise DataError("no surface point is seen by two cameras; choose another scene or path")
    choice = rng.permutation(found)[:wanted]
    points, color = np.concatenate(kept)[choice], np.concatenate(colors)[choice]
    low, high = np.quantile(points, 0.02, axis=0), np.quantile(points, 0.98, axis=0)
    stray = rng.uniform(low - (high - low) / 2, high + (high - low) / 2, (outliers, 3))
    return np.concatenate((points, stray)), np.concatenate((color, rng.integers(0, 256, (outliers, 3), np.uint8)))


def _cumulative_contrast(image: Array) -> Array:
    """Return the cumulative probability [H * W] of a feature at the pixels: solid angle x gradient magnitude."""
    gray = image.astype(np.float32).mean(-1)
    across = np.roll(gray, -1, 1) - np.roll(gray, 1, 1)
    down = np.gradient(gray, axis=0) * 2
    height = len(gray)
    weight = np.cos(((np.arange(height) + 0.5) / height - 0.5) * np.pi)[:, None]
    # Pixels are narrower near the poles: the same contrast there is a steeper edge, but fewer features.
    chance = (np.hypot(across, down) + 1e-3) * weight
    return np.cumsum((chance / chance.sum()).ravel())


def _seen_twice(
    world: World, poses: Array, view: int, pixel: Array, width: int, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Return the surface points [3, n] at pixels of a view that another view sees, their distances, and pixels."""
    rows, columns = np.divmod(pixel, width)
    rays = poses[view, :3, :3].T @ directions(rows + 0.5, columns + 0.5, width, width // 2)
    start = center(poses[view])[:, None]
    distance, object_id = world.nearest(start, rays)
    hit = object_id != SKY
    distance, pixel = distance[hit], pixel[hit]
    points = start + distance * rays[:, hit]
    second = (view + rng.integers(1, len(poses), points.shape[1])) % len(poses)
    other = np.stack([center(pose) for pose in poses])[second].T
    toward = points - other
    far = np.linalg.norm(toward, axis=0)
    visible = world.nearest(other, toward / far)[0] > far * (1 - 1e-4) - 1e-3
    return points[:, visible], distance[visible], pixel[visible]
