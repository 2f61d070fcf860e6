"""Paths from JSON files: keyframes of ours, and camera paths as nerfstudio's viewer saves them.

Ours: {"keyframes": [{"position": [x, y, z], "look_at": [x, y, z]} or {"cam_from_world": 4 rows of 4}, ...],
"up": [x, y, z]}, in the scene's world; frames are spread evenly between them. Nerfstudio's has a pose for each frame
(x right, y up, z backwards), in a world of its own; the file `dataparser_transforms.json` of its run, laid beside it,
says which. That begins at the world before what `transforms.json` names as applied to it; ours is the one after.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from padgs.apps.camera_path_video.paths import between, looking

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
