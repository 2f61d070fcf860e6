"""Conditions of the world frame, the poses and the point cloud. Each is `(scene, value, random) -> scene`.

Test views keep the poses that their images were taken at.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from padgs.data.perturb.condition import condition
from padgs.scene import Scene, View, move_origin

DIAGONAL = (math.sqrt(0.5), math.sqrt(0.5), 0.0)  # horizontal; a rotation about it moves both the y and the z axis
MIN_POINTS = 8  # explicit Gaussians take their first size from their three nearest neighbors
NEAR = 0.02  # scene scales: closer to a camera than any surface
FAR = 10.0  # times the size of the cloud
QUANTILES = (0.02, 0.98)  # of the points, between which the size of the cloud is measured


@condition("the world is rotated by {}° about a tilted axis", 15, 45, 90, test_views=True, allowed=(0.2, 0.3, 0.5))
def world_rotation(scene: Scene, degrees: float, random: np.random.Generator) -> Scene:
    """Rotate the world, cameras included; the images stay the same."""
    world = rotation_about(degrees * np.array(DIAGONAL))
    points = (scene.points.double() @ world.T.to(scene.points.device)).float()

    def move(view: View) -> View:
        pose = view.cam_from_world.clone()
        pose[:3, :3] = view.cam_from_world[:3, :3] @ world.T.to(pose)
        return replace(view, cam_from_world=pose)

    return replace(scene.with_views(move), points=points)


@condition("all lengths in world units are multiplied by {}", 0.1, 10, 100, test_views=True, allowed=(0.1, 0.1, 0.1))
def world_scale(scene: Scene, factor: float, random: np.random.Generator) -> Scene:
    """Scale the world, cameras and depths included; the images stay the same."""

    def move(view: View) -> View:
        pose = view.cam_from_world.clone()
        pose[:3, 3] *= factor
        load = view.load_depth
        return replace(view, cam_from_world=pose, load_depth=None if load is None else lambda: load() * factor)

    return replace(scene.with_views(move), points=scene.points * factor)


@condition("the world is {:g} scene scales away from its origin", 100, 10000, 1000000, test_views=True)
def world_offset(scene: Scene, distance: float, random: np.random.Generator) -> Scene:
    """Move the world `distance` scene scales away from its origin, like georeferenced captures; points in float64."""
    offset = distance * scene.scale * torch.tensor(DIAGONAL, dtype=torch.float64)
    scene = scene.with_views(lambda view: replace(view, cam_from_world=move_origin(view.cam_from_world, -offset)))
    return replace(scene, points=scene.points.double() + offset.to(scene.points.device))


@condition("training cameras are off by {:.1%} of the scene scale", 0.001, 0.005, 0.02, allowed=(0.5, 2.0, 6.0))
def pose_noise(scene: Scene, sigma: float, random: np.random.Generator) -> Scene:
    """Move training cameras by a normal offset with a standard deviation of `sigma` scene scales on each axis."""

    def move(view: View) -> View:
        offset = torch.from_numpy(random.standard_normal(3)).to(view.cam_from_world)
        return replace(view, cam_from_world=move_origin(view.cam_from_world, -sigma * scene.scale * offset))

    return replace(scene, train=tuple(map(move, scene.train)))


@condition("training cameras are rotated by {}°", 0.05, 0.2, 1.0, allowed=(0.5, 3.0, 8.0))
def pose_rotation(scene: Scene, sigma: float, random: np.random.Generator) -> Scene:
    """Rotate training cameras about random axes by a normal angle with a standard deviation of `sigma` degrees."""

    def move(view: View) -> View:
        axis, size = random.standard_normal(3), random.standard_normal()
        return rotate_camera(view, rotation_about(axis / np.linalg.norm(axis) * sigma * size))

    return replace(scene, train=tuple(map(move, scene.train)))


@condition("one of {} training views is left", 2, 4, 8)
def few_views(scene: Scene, every: int, random: np.random.Generator) -> Scene:
    """Keep one of `every` training views, evenly along the capture, and at least two."""
    kept = scene.train[::every] if len(scene.train) > every else (scene.train[0], scene.train[-1])
    return replace(scene, train=kept)


@condition("{:.1%} of the points are left", 0.1, 0.01, 0.001, allowed=(0.5, 1.5, 4.0))
def few_points(scene: Scene, share: float, random: np.random.Generator) -> Scene:
    """Keep a random share of the points, and at least `MIN_POINTS`."""
    count = min(len(scene.points), max(MIN_POINTS, round(share * len(scene.points))))
    kept = torch.from_numpy(np.sort(random.permutation(len(scene.points))[:count]))
    return replace(scene, points=scene.points[kept], point_colors=scene.point_colors[kept])


@condition("the points are gray and random in a {}", "box", "sphere", "sphere and a far shell", allowed=(2.0, 3.0, 5.0))
def random_points(scene: Scene, shape: str, random: np.random.Generator) -> Scene:
    """Replace the points by as many gray ones: uniform in the box of the cloud, or in a sphere around the cameras, or
    there with one in ten in a shell that is `FAR` times as large.
    """
    low, high, center, radius = _cloud_size(scene)
    count = len(scene.points)
    if shape == "box":
        points = random.uniform(low, high, (count, 3))
    else:
        distance = radius * np.cbrt(random.random(count))
        if "shell" in shape:
            distance[: count // 10] = FAR * radius
        points = center + distance[:, None] * _directions(count, random)
    gray = torch.full_like(scene.point_colors, 128)
    return replace(scene, points=torch.from_numpy(points).to(scene.points), point_colors=gray)


@condition("{:.0%} of the points are anywhere in a box 10 times as large", 0.01, 0.05, 0.2, allowed=(0.2, 0.5, 1.0))
def outlier_points(scene: Scene, share: float, random: np.random.Generator) -> Scene:
    """Move a share of the points to anywhere in a box `FAR` times the size of the cloud."""
    low, high, _, _ = _cloud_size(scene)
    middle, half = (low + high) / 2, FAR * (high - low) / 2
    return _move_points(scene, share, lambda count: random.uniform(middle - half, middle + half, (count, 3)), random)


@condition("{:.0%} of the points lie directly in front of the cameras", 0.01, 0.05, 0.1, allowed=(0.5, 0.5, 0.5))
def near_points(scene: Scene, share: float, random: np.random.Generator) -> Scene:
    """Move a share of the points to directly in front of training cameras."""
    centers = np.stack([view.center.cpu().numpy() for view in scene.train])

    def sample(count: int) -> np.ndarray:
        distance = NEAR * scene.scale * random.uniform(0.1, 1, (count, 1))
        return centers[random.integers(len(centers), size=count)] + distance * _directions(count, random)

    return _move_points(scene, share, sample, random)


def rotation_about(vector: Sequence[float] | np.ndarray) -> Tensor:
    """Return the rotation [3, 3] float64 about a vector [3] by its length in degrees."""
    from scipy.spatial.transform import Rotation

    return torch.from_numpy(Rotation.from_rotvec(vector, degrees=True).as_matrix())


def rotate_camera(view: View, rotation: Tensor) -> View:
    """Return the view with its camera frame rotated by a matrix [3, 3] about its own center."""
    pose = view.cam_from_world.clone()
    pose[:3] = rotation.to(pose) @ pose[:3]
    return replace(view, cam_from_world=pose)


def _move_points(scene: Scene, share: float, sample: Callable[[int], np.ndarray], random: np.random.Generator) -> Scene:
    """Return the scene with a random share of its points, colors kept, at the positions that `sample` returns."""
    chosen = random.permutation(len(scene.points))[: round(share * len(scene.points))]
    points = scene.points.clone()
    points[torch.from_numpy(chosen).to(points.device)] = torch.from_numpy(sample(len(chosen))).to(points)
    return replace(scene, points=points)


def _cloud_size(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return the two corners of the cloud's box between `QUANTILES`, the mean of the camera centers, and the cloud's
    radius around it.
    """
    points = scene.points.double().cpu().numpy()
    center = np.mean([view.center.cpu().numpy() for view in scene.train], axis=0)
    radius = np.quantile(np.linalg.norm(points - center, axis=1), QUANTILES[1])
    low, high = np.quantile(points, QUANTILES, axis=0)
    return low, high, center, float(radius)


def _directions(count: int, random: np.random.Generator) -> np.ndarray:
    """Return random unit vectors [count, 3]."""
    vectors = random.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
