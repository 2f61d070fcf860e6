"""OpenSfM's `reconstruction.json` with spherical (equirectangular) cameras.

A shot is the rotation vector and the translation cam from world; camera axes and image are ours.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, Cloud, Frame
from padgs.data.errors import DataError
from padgs.data.formats.json_file import entry, numbers, read_json
from padgs.data.formats.poses import cam_from_world, rotation_from_vector
from padgs.data.options import DataOptions
from padgs.data.splits import check_inside

FILE = "reconstruction.json"
MODELS = ("spherical", "equirectangular")


def read(path: Path, options: DataOptions) -> Capture:
    """Read the reconstruction with the most shots."""
    folder = path.parent if path.is_file() else path
    file = path if path.is_file() else folder / FILE
    parts = read_json(file)
    if not isinstance(parts, list) or not parts:
        raise DataError(f"{file} must hold a list of reconstructions with at least one in it")
    best = max(parts, key=lambda part: len(entry(part, "shots", str(file))))
    images = image_folder(folder, options.images)
    cameras = entry(best, "cameras", str(file))
    frames = []
    for name, shot in best["shots"].items():
        where = f"shot {name} of {file}"
        camera = entry(cameras, str(entry(shot, "camera", where)), f"cameras of {file}")
        model = entry(camera, "projection_type", f"the camera of {where}")
        if model not in MODELS:
            raise DataError(f"{where} has a {model!r} camera; only spherical ones (panoramas) can be used")
        rotation = rotation_from_vector(numbers(entry(shot, "rotation", where), (3,), f"rotation of {where}"), where)
        translation = numbers(entry(shot, "translation", where), (3,), f"translation of {where}")
        pose = cam_from_world(rotation, translation, where)
        name = check_inside(name, str(file))
        frames.append(Frame(name, images / name, pose, camera.get("width"), camera.get("height")))
    used = f"{file.name} holds {len(parts)} reconstructions; the one with most shots, {len(frames)}, is used"
    notes = (used,) if len(parts) > 1 else ()
    return Capture("opensfm", folder, images, tuple(frames), _cloud(best, file), notes=notes)


def _cloud(part: dict, file: Path) -> Cloud | None:
    points = list((part.get("points") or {}).values())
    if not points:
        return None
    where = f"a point of {file}"
    positions = numbers([entry(point, "coordinates", where) for point in points], (len(points), 3), where)
    colors: Tensor | None = None
    if all("color" in point for point in points):
        colors = numbers([point["color"] for point in points], (len(points), 3), f"color of {where}")
        colors = colors.round().clamp(0, 255).to(torch.uint8)
    return Cloud(positions, colors)
