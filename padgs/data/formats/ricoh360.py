"""Ricoh360 scenes as published with EgoNeRF: imgs/, train.txt, test.txt, and COLMAP's text files in output_dir/colmap.

The text files come from OpenMVG and their camera is none of COLMAP's, so they are read here. Names in them may carry
another extension than the images; they are joined without it.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import torch

from padgs.data.assemble import image_folder, image_names
from padgs.data.capture import Capture, Cloud, Frame, color_bytes
from padgs.data.cloud import existing_ply
from padgs.data.errors import DataError
from padgs.data.formats.colmap import image_lines
from padgs.data.formats.poses import cam_from_world, rotation_from_quaternion
from padgs.data.options import DataOptions
from padgs.data.splits import check_inside, read_lines

MODEL = "output_dir/colmap"


def read(path: Path, options: DataOptions) -> Capture:
    """Read poses and points."""
    images = image_folder(path, options.images, ("imgs", "images"))
    files = {str(PurePosixPath(name).with_suffix("")): name for name in image_names(images)}
    files.pop("mask", None)
    mask = path / "imgs" / "mask.png"
    file = path / MODEL / "images.txt"
    frames = []
    for fields in image_lines(file):
        name = check_inside(fields[9], str(file))
        name = files.get(str(PurePosixPath(name).with_suffix("")), name)
        where = f"{name} in {file}"
        try:
            values = torch.tensor([float(field) for field in fields[1:8]], dtype=torch.float64)
        except ValueError as error:
            raise DataError(f"{where}: the pose is not numbers ({error})") from error
        pose = cam_from_world(rotation_from_quaternion(values[:4], where), values[4:], where)
        frames.append(Frame(name, images / name, pose, mask=mask if mask.is_file() else None))
    cloud = existing_ply(path, ("openMVG/scene.ply", "scene.ply", "pcd.ply"))
    points = path / MODEL / "points3D.txt"
    if cloud is None and points.is_file():
        cloud = _cloud(points)
    return Capture("ricoh360", path, images, tuple(frames), cloud)


def _cloud(file: Path) -> Cloud | None:
    rows = [line.split()[1:7] for line in read_lines(file) if line.strip() and not line.startswith("#")]
    if not rows:
        return None
    try:
        values = torch.tensor([[float(field) for field in row] for row in rows], dtype=torch.float64)
    except ValueError as error:
        raise DataError(f"{file}: a point is not 'id x y z red green blue error' ({error})") from error
    if values.shape[1] < 6:
        raise DataError(f"{file}: a point has {values.shape[1] + 1} fields; it must have id x y z red green blue")
    return Cloud(values[:, :3], color_bytes(values[:, 3:6], str(file)))
