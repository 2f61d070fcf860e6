"""What is wrong with the frame that poses and points are in, and with the poses themselves.

Each is `(scene, level, random) -> scene`. Test views keep the poses that their images were taken at.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from padgs.scene import Scene, View

# along the ground, where north and east are; a turn about it puts neither z nor y where it was
DIAGONAL = (math.sqrt(0.5), math.sqrt(0.5), 0.0)


def turned(scene: Scene, degrees: float, random: np.random.Generator) -> Scene:
    """The whole world, cameras included, in a frame that is turned; the images stay what they are."""
    from scipy.spatial.transform import Rotation

    world = torch.from_numpy(Rotation.from_rotvec(degrees * np.array(DIAGONAL), degrees=True).as_matrix())
    points = (scene.points.double() @ world.T.to(scene.points.device)).float()

    def pose(view: View) -> View:
        moved = view.cam_from_world.clone()
        moved[:3, :3] = view.cam_from_world[:3, :3] @ world.T.to(moved)
        return replace(view, cam_from_world=moved)

    return replace(of_all(scene, pose), points=points)


def scaled(scene: Scene, factor: float, random: np.random.Generator) -> Scene:
    """The whole world in another unit of length; the images stay what they are."""

    def pose(view: View) -> View:
        moved = view.cam_from_world.clone()
        moved[:3, 3] *= factor
        load = view.load_depth
        return replace(view, cam_from_world=moved, load_depth=None if load is None else lambda: load() * factor)

    return replace(of_all(scene, pose), points=scene.points * factor)


def moved_away(scene: Scene, units: float, random: np.random.Generator) -> Scene:
    """The whole world so many units of the scene away from the origin, as georeferenced captures are; float64."""
    offset = units * scene.scale * torch.tensor(DIAGONAL, dtype=torch.float64)

    def pose(view: View) -> View:
        moved = view.cam_from_world.clone()
        moved[:3, 3] -= moved[:3, :3] @ offset.to(moved)
        return replace(view, cam_from_world=moved)

    return replace(of_all(scene, pose), points=scene.points.double() + offset.to(scene.points.device))


def shaken(scene: Scene, share: float, random: np.random.Generator) -> Scene:
    """Training cameras stand beside where they stood, by a normal offset of `share` units of the scene on each axis."""

    def pose(view: View) -> View:
        moved, offset = view.cam_from_world.clone(), torch.from_numpy(random.standard_normal(3)).to(view.cam_from_world)
        moved[:3, 3] -= moved[:3, :3] @ (share * scene.scale * offset)
        return replace(view, cam_from_world=moved)

    return of_training(scene, pose)


def twisted(scene: Scene, degrees: float, random: np.random.Generator) -> Scene:
    """Training cameras look beside where they looked: about any axis, by a normal angle of that standard deviation."""

    def pose(view: View) -> View:
        from scipy.spatial.transform import Rotation

        axis, size = random.standard_normal(3), random.standard_normal()
        twist = Rotation.from_rotvec(axis / np.linalg.norm(axis) * degrees * size, degrees=True).as_matrix()
        return facing(view, torch.from_numpy(twist))

    return of_training(scene, pose)


def thinned(scene: Scene, every: int, random: np.random.Generator) -> Scene:
    """One of so many training views is left, evenly along the capture; two at least."""
    kept = scene.train[::every] if len(scene.train) > every else (scene.train[0], scene.train[-1])
    return replace(scene, train=kept)


def facing(view: View, turn: Tensor) -> View:
    """The view with its camera turned by a rotation [3, 3] of the camera frame, about its own centre."""
    moved = view.cam_from_world.clone()
    moved[:3] = turn.to(moved) @ moved[:3]
    return replace(view, cam_from_world=moved)


def of_training(scene: Scene, change: Callable[[View], View]) -> Scene:
    """The scene with its training views changed one after the other."""
    return replace(scene, train=tuple(map(change, scene.train)))


def of_all(scene: Scene, change: Callable[[View], View]) -> Scene:
    """The same with the test views, after the training views."""
    return replace(of_training(scene, change), test=tuple(map(change, scene.test)))
