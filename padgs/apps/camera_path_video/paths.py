"""Paths that a camera takes through a scene: cam_from_world [F, 4, 4] float64 of each frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from padgs.data.natural_order import natural
from padgs.data.trajectory import gravity
from padgs.scene import Scene

SMOOTHING = 0.5  # of the way through the training cameras, in mean distances of neighbours
ORBIT = 0.4  # radius, in largest distances of a training camera from their mean
ALONE = 0.1  # the same where all cameras stand in one place, in units of the scene


def between(poses: Tensor, times: Sequence[float] | np.ndarray) -> Tensor:
    """Poses [T, 4, 4] at times along the way through given ones [F, 4, 4]; 0 is the first of them, F - 1 the last.

    Centres move in straight lines, turns are even.
    """
    from scipy.spatial.transform import Rotation, Slerp

    numbers = np.arange(len(poses))
    given = poses.double().cpu().numpy()
    centers = -np.einsum("fji,fj->fi", given[:, :3, :3], given[:, :3, 3])
    turns = Slerp(numbers, Rotation.from_matrix(given[:, :3, :3]))(times).as_matrix()
    at = np.stack([np.interp(times, numbers, axis) for axis in centers.T], axis=-1)
    return _poses(turns, at)


def along_cameras(scene: Scene, frames: int) -> Tensor:
    """Through the training cameras in the order of their names, at one speed, and smoothly.

    Raises:
        ValueError: there is one camera only, or all stand in one place.
    """
    from scipy.ndimage import gaussian_filter1d
    from scipy.spatial.transform import Rotation

    views = sorted(scene.train, key=lambda view: natural(view.name))
    given = torch.stack([view.cam_from_world for view in views])
    centers = torch.stack([view.center for view in views])
    steps = (centers[1:] - centers[:-1]).norm(dim=-1).cpu().numpy()
    if len(given) < 2 or scene.has_single_center:
        raise ValueError(
            f"{len(given)} training cameras in one place make no path; --path orbit and --path dolly need none"
        )
    walked = np.concatenate(([0.0], np.cumsum(np.maximum(steps, 1e-9 * steps.max()))))
    times = np.interp(np.linspace(0, walked[-1], frames), walked, np.arange(len(walked)))
    poses = between(given, times).numpy()
    width = SMOOTHING * frames / len(steps)
    centers = gaussian_filter1d(-np.einsum("fji,fj->fi", poses[:, :3, :3], poses[:, :3, 3]), width, 0, mode="nearest")
    quats = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    signs = np.where((quats[1:] * quats[:-1]).sum(-1) < 0, -1.0, 1.0)  # q and -q are one turn
    quats[1:] *= np.cumprod(signs)[:, None]
    turns = Rotation.from_quat(gaussian_filter1d(quats, width, 0, mode="nearest")).as_matrix()
    return _poses(turns, centers)


def orbit(scene: Scene, frames: int) -> Tensor:
    """Once around the middle of the training cameras, level, looking across it."""
    middle, up, ahead = _frame(scene)
    angles = 2 * np.pi * np.arange(frames) / frames
    side = np.cross(ahead, up)
    out = np.cos(angles)[:, None] * side - np.sin(angles)[:, None] * ahead
    radius = ORBIT * scene.camera_radius if not scene.has_single_center else ALONE * scene.scale
    return looking(middle + radius * out, -out, up)


def dolly(scene: Scene, frames: int) -> Tensor:
    """Straight through the middle of the training cameras, where they are spread the widest, looking ahead."""
    middle, up, ahead = _frame(scene)
    centers = torch.stack([view.center for view in scene.train]).cpu().numpy()
    along = (centers - middle) @ ahead
    reach = (along.min(), along.max()) if not scene.has_single_center else (-ALONE * scene.scale, ALONE * scene.scale)
    at = middle + np.linspace(*reach, frames)[:, None] * ahead
    return looking(at, np.broadcast_to(ahead, at.shape), up)


PATHS: dict[str, Callable[[Scene, int], Tensor]] = {"cameras": along_cameras, "orbit": orbit, "dolly": dolly}


def looking(centers: np.ndarray, directions: np.ndarray, up: np.ndarray) -> Tensor:
    """Poses of cameras at centres [F, 3] that look along directions [F, 3], `up` [3] upwards in the picture."""
    ahead = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    right = np.cross(ahead, up)
    right[np.linalg.norm(right, axis=-1) < 1e-6] = np.cross(up, np.eye(3)[np.abs(up).argmin()])  # straight up or down
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return _poses(np.stack((right, np.cross(ahead, right), ahead), axis=1), centers)


def _frame(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middle of the training cameras, up, and the level direction in which they are spread the widest."""
    poses = torch.stack([view.cam_from_world for view in scene.train]).double().cpu()
    up = np.array(gravity(poses).up)
    centers = torch.stack([view.center for view in scene.train]).double().cpu().numpy()
    middle = centers.mean(0)
    level = np.eye(3) - np.outer(up, up)
    ahead = np.linalg.svd((centers - middle) @ level)[2][0]
    if scene.has_single_center or np.linalg.norm(level @ ahead) < 1e-6:
        ahead = level @ poses[0, 2, :3].numpy()
    ahead = level @ ahead
    if ahead @ (centers[-1] - centers[0]) < 0:
        ahead = -ahead
    return middle, up, ahead / np.linalg.norm(ahead)


def _poses(turns: np.ndarray, centers: np.ndarray) -> Tensor:
    poses = np.tile(np.eye(4), (len(turns), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns, -np.einsum("fij,fj->fi", turns, centers)
    return torch.from_numpy(poses)
