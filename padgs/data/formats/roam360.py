"""360Roam scenes as published: images/, `pose_c2w.json` (world from camera, our axes; the split) and scene.ply.

Images of 6080 x 3040 are reduced to the 2048 x 1024 of the paper unless data.width says otherwise, and the bottom
rows, which show the tripod, are ignored.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, Frame
from padgs.data.cloud import existing_ply
from padgs.data.datasets import DATASETS
from padgs.data.errors import DataError
from padgs.data.formats.json_file import Json, read_json
from padgs.data.formats.poses import cam_from_pose
from padgs.data.options import DataOptions


def read(path: Path, options: DataOptions) -> Capture:
    """Read the poses and the split."""
    file = path / "pose_c2w.json"
    data = read_json(file)
    images = image_folder(path, options.images)
    frames: list[Frame] = []
    split: dict[str, tuple[str, ...]] = {}
    for side in ("train", "test"):
        names = []
        for item in data[side].entries():
            stated = item["rgb_file"].name()
            name = stated if (images / stated).is_file() else PurePosixPath(stated).name
            matrix = Json(item.value, f"{name} in {file}")["transform_matrix"]
            frames.append(Frame(name, images / name, cam_from_pose(matrix.numbers(4, 4), matrix.where)))
            names.append(name)
        split[side] = tuple(names)
    twice = set(split["train"]) & set(split["test"])
    if twice:
        raise DataError(f"{file}: {sorted(twice)[0]} is both a train and a test view; it may be one of them")
    known = DATASETS["roam360"]
    cloud = existing_ply(path, ("scene.ply", f"{path.name}.ply", "pcd.ply"))
    return Capture("roam360", path, images, tuple(frames), cloud, split, known.mask, known.width)
