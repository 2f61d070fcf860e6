"""COLMAP models, text or binary, of EQUIRECTANGULAR cameras (in forks: SPHERICAL or SPHERE), with photographs beside.

COLMAP's panoramic camera has the axes of `padgs.geometry.panorama`, so poses are used unchanged: those of the images
file, which all versions write.
"""

from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, DataError, DataOptions, Frame, Tracks, by_id, files_with, first_of, listed
from padgs.data.cloud import first_ply, forgiving
from padgs.data.formats import colmap_files as model_files
from padgs.data.formats.colmap_lens import lens_of, pycolmap_module
from padgs.data.formats.poses import cam_from_world, rotation_from_quaternion
from padgs.data.images import EXTENSIONS
from padgs.data.splits import check_name, read_lines

PLY = ("points3D.ply", "points3d.ply", "points.ply", "fused.ply")  # in place of the points file


def find_model(path: Path) -> Path | None:
    """Find the folder with the model's files, in a data set's folder or itself; of several parts that with most images.

    Beside the panoramas images.txt may be anything.
    """
    inside = first_of(path, ("colmap",), Path.is_dir)
    places = [first_of(path, (name,), Path.is_dir) for name in ("sparse_equirectangular", "sparse")]
    for folder in filter(None, (*places, inside and first_of(inside, ("sparse",), Path.is_dir), path)):
        parts = [folder, *sorted(part for part in folder.glob("*") if part.is_dir())] if folder != path else [folder]
        files = {part: file for part in parts if (file := model_files.find_file(part, "images"))}
        if files and (folder != path or model_files.find_file(path, "cameras")):
            first, *others = files
            return max(files, key=lambda part: (_count(files[part]), files[part].stat().st_size)) if others else first
    return None


def _count(file: Path) -> int:
    """Return how many images the images file of a model says that it holds, without reading their poses."""
    if file.suffix.lower() == ".txt":
        return sum(line.strip().lower().endswith(EXTENSIONS) for line in read_lines(file, "replace"))
    with file.open("rb") as content:
        return int.from_bytes(content.read(8), "little")


def read(path: Path, options: DataOptions, model: Path | None = None) -> Capture:
    """Read a COLMAP model of a data set; missing or damaged files are a DataError.

    `model` is the folder with the model's files; None searches the usual places in the data set's folder `path`.
    """
    model = model or find_model(path)
    if model is None:
        raise DataError(f"{path} holds no COLMAP model (cameras, images and points3D as .bin or .txt in sparse/0)")
    files = {name: file for name in model_files.FILES if (file := model_files.find_file(model, name))}
    row_of, cloud, colored = dict[int, int](), None, None
    with forgiving(options.points):
        row_of, cloud = model_files.read_points(files["points3D"]) if "points3D" in files else ({}, None)
    if not row_of and (colored := first_ply(model, PLY, options.points)):
        cloud = colored
    needed = model_files.FILES if colored is None and options.points == "auto" else model_files.FILES[:2]
    if absent := [name for name in needed if name not in files]:
        raise DataError(
            f"the COLMAP model {model} lacks {listed(absent)} (.bin or .txt); export the whole model"
            + (", or set data.points to a PLY file or to random" if absent == ["points3D"] else "")
        )
    folder = image_folder(path, options.images)
    cameras = by_id(model_files.read_cameras(files["cameras"]), str(files["cameras"]))
    images = sorted(model_files.read_images(files["images"]), key=lambda image: image.id)
    by_id(((image.id, (image.name, *image.pose)) for image in images), str(files["images"]))
    where = str(files["images"])
    frames = tuple(_frame(image, cameras.get(image.camera), folder, model, where) for image in images)
    notes = _file_notes(path, model, files, colored is not None)
    if files["images"].suffix.lower() == ".bin" and (stated := _count(files["images"])) > len(images):
        notes.append(f"images.bin states {stated} images and holds {len(images)}, as some versions of COLMAP write it")
    tracks = partial(_tracks, images, row_of)
    return Capture("colmap", path, folder, frames, cloud, tracks=tracks, notes=tuple(notes))


def pose_of(image: model_files.Image, where: str) -> Tensor:
    """Return cam_from_world [4, 4] of an image; `where` names it in errors."""
    pose = torch.tensor(image.pose, dtype=torch.float64)
    return cam_from_world(rotation_from_quaternion(pose[:4], where), pose[4:], where)


def _file_notes(path: Path, model: Path, files: dict[str, Path], colored: bool) -> list[str]:
    """Say which files are used where there are several of one kind."""
    notes = ["points: from a PLY file beside the model, which has no points of its own"] if colored else []
    parts = [part for part in sorted(model.parent.glob("*")) if part != model and model_files.find_file(part, "images")]
    if model != path and parts:
        others = listed(part.name for part in parts)
        notes.append(f"the model has several parts; the largest, {model.name}, is used, not {others}")
    texts = {file.stem for file in files_with(model, ".txt")}
    if double := [file.name for file in files.values() if file.suffix.lower() == ".bin" and file.stem in texts]:
        notes.append(f"the model is there as text and binary; {listed(double)} are used, not the text files")
    return notes


def _frame(image: model_files.Image, camera: model_files.Camera | None, folder: Path, model: Path, file: str) -> Frame:
    name = check_name(image.name, file)
    where = f"{name} in {model}"
    if camera is None:
        raise DataError(f"{where} has a camera that the model does not hold; export the whole model")
    is_named = camera.model not in model_files.PANORAMIC and not camera.model.startswith("type ")
    if is_named and camera.model not in pycolmap_module().CameraModelId.__members__:
        rule = "COLMAP has no such model; panoramas have EQUIRECTANGULAR: write that, if it is one"
        raise DataError(f"{where} has a {camera.model} camera; {rule}")
    middle = camera.width / 2, camera.height / 2
    if camera.model == "SPHERE" and camera.params[1:] != middle:
        raise DataError(f"{where} has a SPHERE with CX CY {camera.params[1:]}; correct them to its middle, {middle}")
    lens = None if camera.model in model_files.PANORAMIC else partial(lens_of, camera, where)
    return Frame(name, folder / name, pose_of(image, where), camera.width, camera.height, lens=lens)


def _tracks(images: list[model_files.Image], row_of: dict[int, int]) -> Tracks:
    """Return the observations of points that exist."""
    return Tracks.from_observations(
        (frame, row_of[point], pixel)
        for frame, image in enumerate(images)
        for point, pixel in zip(image.points.tolist(), image.pixels, strict=True)
        if point in row_of
    )
