"""OmniBlender scenes (EgoNeRF): `transform.json`, images/, train.txt, test.txt; no points.

Poses are world from camera for a camera that looks along -z with y up (OpenGL), in Blender's z-up world.
"""

from __future__ import annotations

from pathlib import Path

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, Frame
from padgs.data.cloud import existing_ply
from padgs.data.formats.json_file import entries, entry, numbers, read_json
from padgs.data.formats.poses import cam_from_opengl_pose
from padgs.data.options import DataOptions
from padgs.data.splits import check_inside

FILE = "transform.json"
_PLY = ("pcd.ply", "scene.ply", "openMVG/scene.ply", "openMVG/reconstruction/colorized.ply")


def read(path: Path, options: DataOptions) -> Capture:
    """Read `transform.json`."""
    folder = path.parent if path.is_file() else path
    file = folder / FILE
    meta = read_json(file)
    images = image_folder(folder, options.images)
    frames = []
    for item in entries(meta, "frames", str(file)):
        name = check_inside(str(entry(item, "file_path", f"a frame of {file}")), str(file))
        where = f"transform_matrix of {name} in {file}"
        pose = numbers(entry(item, "transform_matrix", f"{name} in {file}"), (4, 4), where)
        frames.append(
            Frame(name, images / name, cam_from_opengl_pose(pose, where), meta.get("width"), meta.get("height"))
        )
    return Capture("omniblender", folder, images, tuple(frames), existing_ply(folder, _PLY))
