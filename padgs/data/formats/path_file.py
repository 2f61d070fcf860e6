"""Camera paths in JSON files.

Keyframe files of padgs: {"keyframes": [{"position": [x, y, z], "look_at": [x, y, z]} or {"cam_from_world": 4 rows of
4}, ...], "up": [x, y, z]}, in the world of the data set. Camera paths of nerfstudio's viewer hold one pose per frame (x
right, y up, z backward) in a normalised world, which the run's `dataparser_transforms.json` defines; put that file
beside the path.
"""

import math
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from padgs.data.camera_paths import PATHS, interpolate_poses, look_along
from padgs.data.capture import FARTHEST, DataError
from padgs.data.formats.json_file import Json, read_json
from padgs.data.formats.poses import cam_from_opengl_pose, cam_from_pose, rigid
from padgs.geometry.similarity import Similarity

MAX_FRAMES = 100_000  # longer videos fill the memory
TRANSFORMS = "dataparser_transforms.json"
Axis = tuple[float, float, float]


def read_path(
    file: Path, frames: int | None, up: Axis, transforms: Path | None = None, *, fps: float = 30.0, to_data: bool = True
) -> Tensor:
    """Read the poses [F, 4, 4] of a file of keyframes, or a camera path of nerfstudio; a DataError names the place.

    Poses are resampled evenly to a number of `frames`; None: `fps` for each of the seconds that a camera path states,
    else its own poses, or one second between two keyframes. `up` is the default of keyframes with look_at.
    `transforms` is the file from which the scene was read, if any. `to_data`: map a camera path of nerfstudio to the
    world of the data set; Gaussians that nerfstudio exports are in its own.
    """
    if not file.exists():
        raise DataError(f"the path {file} does not exist; known: {', '.join(PATHS)}, or a JSON file")
    content = read_json(file)
    if cameras := content.get("camera_path"):
        poses = _nerfstudio(cameras, file.parent / TRANSFORMS if to_data else None, transforms)
        if frames is None and (stated := content.get("seconds")):
            seconds = stated.numbers()
            if seconds.ndim or not 0 < seconds * fps <= MAX_FRAMES:
                rule = f"it must be a number above 0, for at most {MAX_FRAMES} frames at {fps:g} a second"
                raise DataError(f"{stated.where} is {stated.value}; {rule}")
            frames = max(2, round(seconds.item() * fps))
    else:
        stated = content.get("up")
        upwards = stated.numbers(3) if stated else torch.tensor(up, dtype=torch.float64)
        poses = [_keyframe(entry, upwards) for entry in content["keyframes"].entries()]
        frames = frames or max(2, round(fps * (len(poses) - 1)))
    if len(poses) < 2:
        raise DataError(f"{file} has {len(poses)} poses; a path needs at least two")
    if (count := frames or len(poses)) > MAX_FRAMES:
        raise DataError(f"{file} gives {count} frames; a video has at most {MAX_FRAMES}: set --seconds")
    found = torch.stack(poses)
    return found if frames is None else interpolate_poses(found, np.linspace(0, len(poses) - 1, frames))


def _keyframe(entry: Json, up: Tensor) -> Tensor:
    if pose := entry.get("cam_from_world"):
        return torch.linalg.inv(cam_from_pose(pose.numbers(), pose.where))
    position, target = entry["position"].numbers(3), entry["look_at"].numbers(3)
    if not (torch.cat((position, target, up)).abs() <= FARTHEST).all():
        rule = f"not finite, or beyond {FARTHEST:g}"
        raise DataError(f"{entry.where}: position, look_at or up is {rule}; give smaller numbers")
    if up.norm() < 1e-12:
        raise DataError(f"{entry.where}: up is 0; give a direction")
    if (target - position).norm() <= 1e-12 * position.norm().clamp(min=1e-12):
        raise DataError(f"{entry.where}: position and look_at are both {position.tolist()}; give different ones")
    return look_along(position[None].numpy(), (target - position)[None].numpy(), (up / up.norm()).numpy())[0]


def _nerfstudio(cameras: Json, normalized: Path | None, transforms_json: Path | None) -> list[Tensor]:
    world = Similarity()
    if normalized is not None and normalized.is_file():
        world = nerfstudio_world(normalized, transforms_json)
    elif normalized is not None:
        where = f"there is no {normalized.name} beside the camera path"
        warnings.warn(f"{where}: it is taken to be in the world of the data set; copy it from the run", stacklevel=2)
    poses = []
    if any(entry.get("fov") for entry in cameras.entries()):
        warnings.warn("the fields of view of the camera path are not used; set --camera and --fov", stacklevel=2)
    for entry in cameras.entries():
        stated = entry["camera_to_world"]
        matrix = stated.numbers()
        if matrix.numel() != 16:
            raise DataError(f"{stated.where} has {matrix.numel()} numbers; a pose has 16")
        poses.append(world.pose(cam_from_opengl_pose(matrix.reshape(4, 4), stated.where)))
    return poses


def nerfstudio_world(normalized: Path, transforms_json: Path | None) -> Similarity:
    """Return data_from_nerfstudio; a DataError if the files do not state it.

    nerfstudio's world is s (T @ x) for x in the data set's world, by scale and transform of `normalized`.
    """
    values = read_json(normalized)  # nerfstudio = scale (transform @ original); padgs = applied_transform @ original
    applied = Json({}, "") if transforms_json is None else read_json(transforms_json)
    before, factor = applied.get("applied_transform"), applied.get("applied_scale")
    transform = _homogeneous(values["transform"])
    if before:
        transform = transform @ torch.linalg.inv(_homogeneous(before))
    scale = values["scale"].numbers().item() / (factor.numbers().item() if factor else 1.0)
    if not 0 < scale < math.inf:
        raise DataError(f"{values['scale'].where} makes a scale of {scale:g}; it must be above 0: copy it from the run")
    return Similarity(scale, transform[:3, :3], scale * transform[:3, 3]).inverse()


def _homogeneous(rows: Json) -> Tensor:
    matrix = rows.numbers(3, 4)
    return rigid(matrix[:, :3], matrix[:, 3])
