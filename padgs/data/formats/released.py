"""The processed folders that the released PaD-GS and ODGS programs train on.

images/, data_views.json, data_extrinsics.json, pcd.ply (or colorized.ply), train.txt and test.txt. As in those
programs views and extrinsics are joined by their keys, and sizes are those of the images.
"""

from __future__ import annotations

from pathlib import Path

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, Frame
from padgs.data.cloud import existing_ply
from padgs.data.formats.json_file import read_json
from padgs.data.formats.openmvg import read_extrinsics, read_views
from padgs.data.options import DataOptions


def read(path: Path, options: DataOptions) -> Capture:
    """Read the views, the extrinsics and the cloud."""
    views = read_views(read_json(path / "data_views.json"))
    poses = read_extrinsics(read_json(path / "data_extrinsics.json"))
    images = image_folder(path, options.images)
    frames = tuple(Frame(view.name, images / view.name, poses[view.key]) for view in views if view.key in poses)
    return Capture("released", path, images, frames, existing_ply(path, ("pcd.ply", "colorized.ply")))
