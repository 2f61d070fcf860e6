"""Camera paths: their extent and up direction, paths made from a scene, and paths read from JSON files."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from padgs.data.capture import natural
from padgs.scene import Scene


@dataclass(frozen=True)
class Gravity:
    """The direction that the cameras agree to call up, in the world frame."""

    up: tuple[float, float, float]
    agreement: float  # length of the mean of the cameras' up directions: 1 = all level, 0 = no common direction
    axis: str  # the world axis nearest to it: +x, -x, ...
    off_axis: float  # degrees between the two
    tilt: float  # degrees, median angle of a camera's own up to the common one


def gravity(poses: Tensor) -> Gravity:
    """Up of the world from cam_from_world [F, 4, 4]: panoramic cameras are mostly upright, so -y averages to up."""
    ups = -poses[:, 1, :3]  # the camera's -y in the world: minus the second row of the rotation
    mean = ups.mean(0)
    up = mean / mean.norm().clamp(min=1e-12)
    strongest = int(up.abs().argmax())
    sign = "+" if up[strongest] > 0 else "-"
    return Gravity(
        up=(up[0].item(), up[1].item(), up[2].item()),
        agreement=mean.norm().item(),
        axis=f"{sign}{'xyz'[strongest]}",
        off_axis=_degrees(up[strongest].abs()),
        tilt=_degrees((ups @ up).median()),
    )


def path_length(poses: Tensor) -> float:
    """Length of the way from camera centre to camera centre in the order given, world units."""
    return (centers(poses)[1:] - centers(poses)[:-1]).norm(dim=1).sum().item()


def median_depth(poses: Tensor, points: Tensor) -> float:
    """Median distance from a camera to a point, world units."""
    some = points[:: max(1, len(points) // 20_000)].double()
    return torch.cdist(centers(poses), some).median().item()


def centers(poses: Tensor) -> Tensor:
    """Camera centres [F, 3] of cam_from_world [F, 4, 4]."""
    return -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0]


def _degrees(cosine: Tensor) -> float:
    return torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).item()


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


TRANSFORMS = "dataparser_transforms.json"


class PathError(ValueError):
    """A file of a path that cannot be used; the message says what is wrong where."""


def read_path(file: Path, frames: int | None, up: tuple[float, float, float], described: Path | None = None) -> Tensor:
    """The poses of a file, [F, 4, 4] float64 cam_from_world.

    Args:
        file: see above.
        frames: how many there shall be, spread evenly; None: those of a camera path as they are, and 30 between two
            keyframes.
        up: what is up for keyframes that look at something, unless the file says so.
        described: the `transforms.json` of the scene, if it was read from one.

    Raises:
        PathError: it cannot be read, or is neither.
    """
    try:
        content = json.loads(file.read_text())
    except FileNotFoundError as error:
        raise PathError(f"there is no path {file}; known: cameras, orbit, dolly, or a JSON file") from error
    except (OSError, ValueError) as error:
        raise PathError(f"{file} is no readable JSON: {error}") from error
    try:
        if "camera_path" in content:
            poses = _nerfstudio(content["camera_path"], file.parent / TRANSFORMS, described)
        else:
            poses = torch.cat([_keyframe(entry, content.get("up", up)) for entry in content["keyframes"]])
            frames = frames or 30 * (len(poses) - 1)
    except (KeyError, TypeError, ValueError, IndexError, OSError) as error:
        raise PathError(
            f"{file} is no path ({type(error).__name__}: {error}); it needs keyframes with position and look_at, or "
            "nerfstudio's camera_path with camera_to_world"
        ) from error
    if len(poses) < 2:
        raise PathError(f"{file} has {len(poses)} poses; a path needs two")
    return poses if frames is None else between(poses, np.linspace(0, len(poses) - 1, frames))


def _keyframe(entry: dict[str, Any], up: Any) -> Tensor:
    if "cam_from_world" in entry:
        return _rigid(np.array(entry["cam_from_world"], dtype=np.float64).reshape(1, 4, 4))
    place, target = (np.array([entry[name]], dtype=np.float64).reshape(1, 3) for name in ("position", "look_at"))
    up = np.array(up, dtype=np.float64).reshape(3)
    if not np.isfinite([*place, *target, up]).all():
        raise ValueError(f"position, look_at or up is not finite: {place[0]}, {target[0]}, {up}")
    if (place == target).all() or not up.any():
        raise ValueError(f"position and look_at are both {place[0]}, or up is 0: neither says where to look")
    return looking(place, target - place, up / np.linalg.norm(up))


def _nerfstudio(cameras: list[dict[str, Any]], transforms: Path, described: Path | None) -> Tensor:
    world_from_cam = np.array([camera["camera_to_world"] for camera in cameras], dtype=np.float64).reshape(-1, 4, 4)
    world_from_cam[:, :3, 1:3] *= -1  # to y down, z forward
    if transforms.is_file():  # theirs = scale (transform @ original), and ours = applied_transform @ original
        told = json.loads(transforms.read_text())
        applied = {} if described is None else json.loads(described.read_text(encoding="utf-8-sig"))
        to_ours = _homogeneous(applied.get("applied_transform", np.eye(3, 4)))
        transform = _homogeneous(told["transform"]) @ np.linalg.inv(to_ours)
        scale = told["scale"] / applied.get("applied_scale", 1.0)
        world_from_cam[:, :3, 3] = (world_from_cam[:, :3, 3] / scale - transform[:3, 3]) @ transform[:3, :3]
        world_from_cam[:, :3, :3] = transform[:3, :3].T @ world_from_cam[:, :3, :3]
    return _rigid(np.linalg.inv(world_from_cam))


def _homogeneous(rows: Any) -> np.ndarray:
    return np.vstack((np.array(rows, dtype=np.float64).reshape(3, 4), (0, 0, 0, 1)))


def _rigid(poses: np.ndarray) -> Tensor:
    turns = poses[:, :3, :3]
    if not np.isfinite(poses).all():
        raise ValueError("a pose is not finite")
    if not np.allclose(turns @ turns.swapaxes(1, 2), np.eye(3), atol=1e-3) or np.linalg.det(turns).min() < 0:
        raise ValueError("a pose has a 3x3 part that is not a rotation")
    return torch.from_numpy(poses)
