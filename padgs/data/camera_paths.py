"""Camera paths: statistics of poses, and paths through a scene. Poses are cam_from_world [F, 4, 4] float64."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from padgs.data.capture import natural_key
from padgs.scene import Scene

SMOOTHING = 0.5  # standard deviation, in mean distances of neighbouring training cameras
ORBIT_RADIUS = 0.4  # in camera radii of the scene
SINGLE_CENTER_RADIUS = 0.1  # of orbit and dolly if all cameras share one centre, in scene scales


@dataclass(frozen=True)
class Gravity:
    """Common up direction of cameras, in the world frame."""

    up: tuple[float, float, float]
    agreement: float  # length of the mean of the cameras' up directions: 1 = all upright, 0 = no common direction
    axis: str  # nearest world axis: +x, -x, ...
    off_axis: float  # degrees between `up` and `axis`
    tilt: float  # degrees, median angle between a camera's up and the common one


def gravity(poses: Tensor) -> Gravity:
    """Estimate the world's up direction from poses [F, 4, 4]: panoramic cameras are mostly upright."""
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
    """Return the length of the path through the camera centres in the given order, in world units."""
    return centers(poses).diff(dim=0).norm(dim=1).sum().item()


def centers(poses: Tensor) -> Tensor:
    """Return the camera centres [F, 3] of poses [F, 4, 4]."""
    return -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0]


def _degrees(cosine: Tensor) -> float:
    return torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).item()


def interpolate_poses(poses: Tensor, times: Sequence[float] | np.ndarray) -> Tensor:
    """Interpolate poses [F, 4, 4] at times in [0, F - 1]: centres linearly, rotations spherically. [T, 4, 4]."""
    from scipy.spatial.transform import Rotation, Slerp

    numbers, poses = np.arange(len(poses)), poses.double().cpu()
    rotations = Slerp(numbers, Rotation.from_matrix(poses[:, :3, :3].numpy()))(times).as_matrix()
    at = np.stack([np.interp(times, numbers, axis) for axis in centers(poses).numpy().T], axis=-1)
    return _poses(rotations, at)


def along_cameras(scene: Scene, frames: int) -> Tensor:
    """Return a smooth path of constant speed through training panoramas by name; a ValueError if centres are equal."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.spatial.transform import Rotation

    views = sorted(scene.panoramas, key=lambda view: natural_key(view.name))
    given = torch.stack([view.cam_from_world for view in views])
    steps = centers(given).diff(dim=0).norm(dim=-1).cpu().numpy()
    if len(given) < 2 or scene.has_single_center:
        raise ValueError(f"{len(given)} training cameras with one centre make no path; use --path orbit or dolly")
    distance = np.concatenate(([0.0], np.cumsum(np.maximum(steps, 1e-9 * steps.max()))))
    times = np.interp(np.linspace(0, distance[-1], frames), distance, np.arange(len(distance)))
    poses = interpolate_poses(given, times)
    width = SMOOTHING * frames / len(steps)
    at = gaussian_filter1d(centers(poses).numpy(), width, 0, mode="nearest")
    quats = Rotation.from_matrix(poses[:, :3, :3].numpy()).as_quat()
    signs = np.where((quats[1:] * quats[:-1]).sum(-1) < 0, -1.0, 1.0)  # q and -q are one turn
    quats[1:] *= np.cumprod(signs)[:, None]
    rotations = Rotation.from_quat(gaussian_filter1d(quats, width, 0, mode="nearest")).as_matrix()
    return _poses(rotations, at)


def orbit(scene: Scene, frames: int) -> Tensor:
    """Return a level circle around the mean training camera, looking through its centre."""
    middle, up, forward = _frame(scene)
    angles = 2 * np.pi * np.arange(frames) / frames
    side = np.cross(forward, up)
    out = np.cos(angles)[:, None] * side - np.sin(angles)[:, None] * forward
    radius = ORBIT_RADIUS * scene.camera_radius if not scene.has_single_center else SINGLE_CENTER_RADIUS * scene.scale
    return look_along(middle + radius * out, -out, up)


def dolly(scene: Scene, frames: int) -> Tensor:
    """Return a straight path through the mean training camera, along their widest level direction, looking ahead."""
    middle, up, forward = _frame(scene)
    along = (torch.stack([view.center for view in scene.train]).cpu().numpy() - middle) @ forward
    single = SINGLE_CENTER_RADIUS * scene.scale
    reach = (-single, single) if scene.has_single_center else (along.min(), along.max())
    at = middle + np.linspace(*reach, frames)[:, None] * forward
    return look_along(at, np.broadcast_to(forward, at.shape), up)


PATHS: dict[str, Callable[[Scene, int], Tensor]] = {"cameras": along_cameras, "orbit": orbit, "dolly": dolly}


def look_along(centers: np.ndarray, directions: np.ndarray, up: np.ndarray) -> Tensor:
    """Return poses of cameras at centres [F, 3] that look along directions [F, 3], with `up` [3] upwards."""
    forward = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    right = np.cross(forward, up)
    right[np.linalg.norm(right, axis=-1) < 1e-6] = np.cross(up, np.eye(3)[np.abs(up).argmin()])  # vertical
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return _poses(np.stack((right, np.cross(forward, right), forward), axis=1), centers)


def _frame(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean centre of the training cameras, up, and the level direction of their widest extent."""
    poses = torch.stack([view.cam_from_world for view in scene.panoramas]).double().cpu()
    up, at = np.array(gravity(poses).up), centers(poses).numpy()
    middle = at.mean(0)
    level = np.eye(3) - np.outer(up, up)
    forward = np.linalg.svd((at - middle) @ level)[2][0]
    if scene.has_single_center or np.linalg.norm(level @ forward) < 1e-6:
        forward = level @ poses[0, 2, :3].numpy()
    forward = level @ forward
    if forward @ (at[-1] - at[0]) < 0:
        forward = -forward
    return middle, up, forward / np.linalg.norm(forward)


def _poses(rotations: np.ndarray, centers: np.ndarray) -> Tensor:
    poses = np.tile(np.eye(4), (len(rotations), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, -np.einsum("fij,fj->fi", rotations, centers)
    return torch.from_numpy(poses)
