"""OpenSfM's `reconstruction.json` with spherical (equirectangular) cameras.

A shot holds the rotation vector and translation of cam_from_world; camera axes are those of `padgs.geometry.panorama`.
"""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, Cloud, DataError, DataOptions, Frame
from padgs.data.cloud import color_bytes, whole_if_possible
from padgs.data.formats.json_file import Json, file_in, read_json
from padgs.data.formats.poses import cam_from_world, rotation_from_vector
from padgs.data.splits import check_name

MODELS = ("spherical", "equirectangular")


def read(path: Path, options: DataOptions) -> Capture:
    """Read the reconstruction with the most shots."""
    file = file_in(path, "reconstruction.json")
    parts = read_json(file).entries()
    if not parts:
        raise DataError(f"{file} must hold a list of reconstructions with at least one in it")
    best = max(parts, key=lambda part: len(part["shots"].items()))
    images = image_folder(file.parent, options.images)
    frames = []
    for name, value in best["shots"].items().items():
        shot = Json(value.value, f"shot {name} of {file}")
        camera = best["cameras"][shot["camera"].text()]
        model = camera["projection_type"].text()
        if model not in MODELS:
            raise DataError(f"{shot.where} has a {model!r} camera; only spherical cameras (panoramas) can be used")
        rotation = rotation_from_vector(shot["rotation"].numbers(3), shot.where)
        pose = cam_from_world(rotation, shot["translation"].numbers(3), shot.where)
        check_name(name, str(file))
        width, height = (side and side.whole() for side in (camera.get("width"), camera.get("height")))
        frames.append(Frame(name, images / name, pose, width, height))
    used = f"{file.name} holds {len(parts)} reconstructions; the one with the most shots, {len(frames)}, is used"
    notes = (used,) if len(parts) > 1 else ()
    return Capture("opensfm", file.parent, images, tuple(frames), _cloud(best), notes=notes)


def _cloud(part: Json) -> Cloud | None:
    stated = part.get("points")
    points = list(stated.items().values()) if stated else []
    if not points:
        return None
    where = f"the points of {part.where}"
    positions = Json([point["coordinates"].value for point in points], where)
    colors: Tensor | None = None
    stated = [point.get("color") for point in points]
    if all(stated):
        values = Json([color.value for color in stated if color], f"color of {where}").numbers(len(points), 3)
        colors = color_bytes(whole_if_possible(values.numpy()), where)
    return Cloud(positions.numbers(len(points), 3), colors)
