"""OpenMVG's `sfm_data.json` with a spherical camera: views, intrinsics, extrinsics, structure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, Cloud, Frame, Tracks
from padgs.data.cloud import existing_ply
from padgs.data.errors import DataError
from padgs.data.formats.json_file import entries, entry, numbers, read_json
from padgs.data.formats.openmvg_views import read_extrinsics, read_views
from padgs.data.options import DataOptions

FILE = "sfm_data.json"
_PLY = ("colorized.ply", "scene.ply", "pcd.ply")


def read(path: Path, options: DataOptions) -> Capture:
    """Read `sfm_data.json`. Its points have no colours; a colorized.ply beside it is preferred."""
    folder = path.parent if path.is_file() else path
    file = path if path.is_file() else folder / FILE
    data = read_json(file)
    _check_cameras(data, file)
    views, poses = read_views(data, file), read_extrinsics(data, file)
    root = Path(str(data.get("root_path", "")))  # where it was on the machine that reconstructed
    usual = ("images", "imgs", root.name) if root.name else ("images", "imgs")
    images = image_folder(folder, options.images, usual)
    if options.images is None and images == folder and root.is_dir():
        images = root
    posed = [view for view in views if view.pose in poses]
    frames = tuple(Frame(view.name, images / view.name, poses[view.pose], view.width, view.height) for view in posed)
    structure = data.get("structure") or []
    colored = existing_ply(folder, _PLY)
    cloud = colored
    if cloud is None and structure:
        where = f"X of the structure of {file}"
        points = [entry(entry(item, "value", where), "X", where) for item in structure]
        cloud = Cloud(numbers(points, (len(points), 3), where), None)
    return Capture(
        format="openmvg",
        folder=folder,
        image_folder=images,
        frames=frames,
        cloud=cloud,
        tracks=(lambda: _tracks(structure, {view.key: i for i, view in enumerate(posed)})) if colored is None else None,
        notes=() if colored is None else ("points: from the PLY file beside sfm_data.json, which has colours",),
    )


def _check_cameras(data: Any, file: Path) -> None:
    """cereal names a class where it first occurs, so a file of only spherical cameras names "spherical" once."""
    for item in entries(data, "intrinsics", str(file)):
        name = entry(item, "value", f"an intrinsic of {file}").get("polymorphic_name")
        if name not in (None, "spherical"):
            raise DataError(f"{file} holds a {name!r} camera; only spherical ones (panoramas) can be used")


def _tracks(structure: list[Any], frame_of_view: dict[int, int]) -> Tracks:
    frame, point, pixels = [], [], []
    for i, item in enumerate(structure):
        for seen in item["value"].get("observations", []):
            if seen["key"] in frame_of_view:
                frame.append(frame_of_view[seen["key"]])
                point.append(i)
                pixels.append(seen["value"]["x"])
    return Tracks(
        torch.tensor(frame, dtype=torch.int64),
        torch.tensor(point, dtype=torch.int64),
        torch.tensor(pixels, dtype=torch.float64).reshape(-1, 2),
    )
