"""Readers of published data sets: 360Roam, Ricoh360 and OmniBlender.

360Roam: images/, `pose_c2w.json` (world from camera, OpenCV axes; includes the split) and scene.ply. Images of
6080 x 3040 are reduced to the paper's 2048 x 1024 unless data.width is set; the bottom rows (tripod) are masked.

Ricoh360 (EgoNeRF): imgs/, train.txt, test.txt, and COLMAP text files in output_dir/colmap. They were written by OpenMVG
with a camera unknown to COLMAP, so they are parsed here. Their names may differ from the images in extension.

OmniBlender (EgoNeRF): `transform.json`, images/, train.txt, test.txt; no points. Poses are world from camera, with
OpenGL axes, in Blender's z-up world.
"""

from __future__ import annotations

from pathlib import Path

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, DataError, DataOptions, Frame
from padgs.data.cloud import first_ply
from padgs.data.datasets import DATASETS
from padgs.data.formats.colmap import pose_of
from padgs.data.formats.colmap_files import read_images, read_points
from padgs.data.formats.json_file import Json, file_in, read_json
from padgs.data.formats.poses import cam_from_opengl_pose, cam_from_pose
from padgs.data.splits import check_name


def read_roam360(path: Path, options: DataOptions) -> Capture:
    """Read poses, split and points of a 360Roam scene."""
    file = path / "pose_c2w.json"
    data = read_json(file)
    images = image_folder(path, options.images)
    frames: list[Frame] = []
    split: dict[str, tuple[str, ...]] = {}
    for side in ("train", "test"):
        names = []
        for item in data[side].entries():
            name = item["rgb_file"].name()
            matrix = Json(item.value, f"{name} in {file}")["transform_matrix"]
            frames.append(Frame(name, images / name, cam_from_pose(matrix.numbers(4, 4), matrix.where)))
            names.append(name)
        split[side] = tuple(names)
    twice = set(split["train"]) & set(split["test"])
    if twice:
        raise DataError(f"{file}: {sorted(twice)[0]} is both a train and a test view; keep it in one list")
    known = DATASETS["roam360"]
    cloud = first_ply(path, ("scene.ply", f"{path.name}.ply", "pcd.ply"))
    return Capture("roam360", path, images, tuple(frames), cloud, split, known.mask, known.width)


_RICOH360_MODEL = "output_dir/colmap"


def read_ricoh360(path: Path, options: DataOptions) -> Capture:
    """Read poses and points of a Ricoh360 scene."""
    images = image_folder(path, options.images, ("imgs", "images"))
    mask = path / "imgs" / "mask.png"
    file = path / _RICOH360_MODEL / "images.txt"
    frames = []
    for image in read_images(file):
        name = check_name(image.name, str(file))
        pose = pose_of(image, f"{name} in {file}")
        frames.append(Frame(name, images / name, pose, mask=mask if mask.is_file() else None))
    cloud = first_ply(path, ("openMVG/scene.ply", "scene.ply", "pcd.ply"))
    points = path / _RICOH360_MODEL / "points3D.txt"
    if cloud is None and points.is_file():
        cloud = read_points(points).cloud
    return Capture("ricoh360", path, images, tuple(frames), cloud)


_OMNIBLENDER_CLOUDS = ("pcd.ply", "scene.ply", "openMVG/scene.ply", "openMVG/reconstruction/colorized.ply")


def read_omniblender(path: Path, options: DataOptions) -> Capture:
    """Read `transform.json` of an OmniBlender scene."""
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
    return Capture("omniblender", file.parent, images, tuple(frames), first_ply(file.parent, _OMNIBLENDER_CLOUDS))
