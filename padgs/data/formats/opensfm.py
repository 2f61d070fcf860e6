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
from padgs.data.formats.json_file import Json, file_in, read_json
from padgs.data.formats.poses import cam_from_world, rotation_from_vector
from padgs.data.options import DataOptions
from padgs.data.splits import check_inside

MODELS = ("spherical", "equirectangular")


def read(path: Path, options: DataOptions) -> Capture:
    """Read the reconstruction with the most shots."""
    file = file_in(path, "reconstruction.json")
    parts = read_json(file)
    if not isinstance(parts.value, list) or not parts.value:
        raise DataError(f"{file} must hold a list of reconstructions with at least one in it")
    best = max(parts.entries(), key=lambda part: len(part["shots"].value))
    images = image_folder(file.parent, options.images)
    frames = []
    for name, value in best["shots"].value.items():
        shot = Json(value, f"shot {name} of {file}")
        camera = best["cameras"][str(shot["camera"].value)]
        model = camera["projection_type"].value
        if model not in MODELS:
            raise DataError(f"{shot.where} has a {model!r} camera; only spherical ones (panoramas) can be used")
        rotation = rotation_from_vector(shot["rotation"].numbers(3), shot.where)
        pose = cam_from_world(rotation, shot["translation"].numbers(3), shot.where)
        name = check_inside(name, str(file))
        frames.append(Frame(name, images / name, pose, camera.get("width"), camera.get("height")))
    used = f"{file.name} holds {len(parts.value)} reconstructions; the one with most shots, {len(frames)}, is used"
    notes = (used,) if len(parts.value) > 1 else ()
    return Capture("opensfm", file.parent, images, tuple(frames), _cloud(best), notes=notes)


def _cloud(part: Json) -> Cloud | None:
    points = list((part.get("points") or {}).values())
    if not points:
        return None
    where = f"the points of {part.where}"
    positions = Json([Json(point, f"one of {where}")["coordinates"].value for point in points], where)
    colors: Tensor | None = None
    if all("color" in point for point in points):
        colors = Json([point["color"] for point in points], f"color of {where}").numbers(len(points), 3)
        colors = colors.round().clamp(0, 255).to(torch.uint8)
    return Cloud(positions.numbers(len(points), 3), colors)
