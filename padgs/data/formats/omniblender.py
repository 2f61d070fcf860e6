"""OmniBlender scenes (EgoNeRF): `transform.json`, images/, train.txt, test.txt; no points.

Poses are world from camera for a camera that looks along -z with y up (OpenGL), in Blender's z-up world.
"""

from __future__ import annotations

from pathlib import Path

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, Frame
from padgs.data.cloud import existing_ply
from padgs.data.formats.json_file import Json, file_in, read_json
from padgs.data.formats.poses import cam_from_opengl_pose
from padgs.data.options import DataOptions

_PLY = ("pcd.ply", "scene.ply", "openMVG/scene.ply", "openMVG/reconstruction/colorized.ply")


def read(path: Path, options: DataOptions) -> Capture:
    """Read `transform.json`."""
    file = file_in(path, "transform.json")
    meta = read_json(file)
    images = image_folder(file.parent, options.images)
    width, height = (side and side.whole() for side in (meta.get("width"), meta.get("height")))
    frames = []
    for item in meta["frames"].entries():
        name = item["file_path"].name()
        matrix = Json(item.value, f"{name} in {file}")["transform_matrix"]
        pose = cam_from_opengl_pose(matrix.numbers(4, 4), matrix.where)
        frames.append(Frame(name, images / name, pose, width, height))
    return Capture("omniblender", file.parent, images, tuple(frames), existing_ply(file.parent, _PLY))
