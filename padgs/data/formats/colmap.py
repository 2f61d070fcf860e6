"""COLMAP models, text or binary, with or without rigs, of EQUIRECTANGULAR cameras (in forks: SPHERICAL).

COLMAP's panoramic camera has the axes of `padgs.geometry.panorama`, so poses are used unchanged.
"""

from __future__ import annotations

import re
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, Cloud, DataError, DataOptions, Frame, Tracks, listed
from padgs.data.formats.poses import cam_from_world, checked_quaternion
from padgs.data.images import read_bytes
from padgs.data.splits import check_inside

FILES = ("cameras", "images", "points3D")
_ALIAS = re.compile(r"^(\s*\d+\s+)SPHERICAL\s+(\d+)\s+(\d+).*$", re.MULTILINE)


def find_model(path: Path) -> Path | None:
    """Find the folder with the model's files, in a data set's folder or itself; the largest of several parts."""
    for folder in (path / "sparse_equirectangular", path / "sparse", path / "colmap" / "sparse", path):
        parts = [folder, *sorted(part for part in folder.glob("*") if part.is_dir())] if folder != path else [folder]
        found = [part for part in parts if _suffix(part)]
        if found:
            return max(found, key=lambda part: (part / f"images{_suffix(part)}").stat().st_size)
    return None


def read(path: Path, options: DataOptions, model: Path | None = None) -> Capture:
    """Read a COLMAP model.

    Args:
        path: the data set's folder.
        options: only `images` is used.
        model: the folder with the model's files; None searches the usual places.

    Raises:
        DataError: missing or damaged files, a camera that is not panoramic, or no pose.
    """
    model = model or find_model(path)
    if model is None:
        raise DataError(f"{path} holds no COLMAP model (cameras, images and points3D as .bin or .txt in sparse/0)")
    suffix = _suffix(model)
    absent = [f"{name}{suffix}" for name in FILES if not (model / f"{name}{suffix}").is_file()]
    if absent:
        raise DataError(f"the COLMAP model {model} lacks {listed(absent)}; export the whole model")
    folder = image_folder(path, options.images)
    reconstruction = _open(model, str(suffix))
    images = [image for _, image in sorted(reconstruction.images.items()) if image.has_pose]
    notes = _part_notes(path, model)
    # pycolmap cuts names in text models at the first space.
    names = {int(line[0]): line[9] for line in image_lines(model / "images.txt")} if suffix == ".txt" else {}
    without = [image.name for image in reconstruction.images.values() if not image.has_pose]
    if without:
        notes.append(f"{len(without)} images of the model are not registered: {listed(sorted(without))}")
    frames = tuple(_frame(image, names.get(image.image_id) or str(image.name), folder, model) for image in images)
    cloud, row_of = cloud_of(reconstruction)
    return Capture(
        format="colmap",
        folder=path,
        image_folder=folder,
        frames=frames,
        cloud=cloud,
        tracks=lambda: _tracks(images, row_of),
        notes=tuple(notes),
    )


def pycolmap_module() -> ModuleType:
    """Import pycolmap without breaking PNG files of Pillow."""
    import zlib  # noqa: F401 - first, or pycolmap's deflate symbols replace the system's

    import pycolmap

    return pycolmap


def cloud_of(reconstruction: Any) -> tuple[Cloud, dict[int, int]]:
    """Return the points of a pycolmap.Reconstruction, and the row of each point id."""
    ids = sorted(reconstruction.points3D.keys())
    points = [reconstruction.points3D[point_id] for point_id in ids]
    cloud = Cloud(
        torch.from_numpy(np.array([point.xyz for point in points], np.float64).reshape(-1, 3)),
        torch.from_numpy(np.array([point.color for point in points], np.uint8).reshape(-1, 3)),
    )
    return cloud, {point_id: row for row, point_id in enumerate(ids)}


def image_lines(file: Path) -> list[list[str]]:
    """Read the ten fields of every image in images.txt; observations, on every second line, are skipped.

    Raises:
        DataError: missing file, or a line with fewer fields.
    """
    lines = iter(read_bytes(file).decode("utf-8", "surrogateescape").splitlines())
    found = []
    for line in lines:
        if line.strip() and not line.startswith("#"):
            found.append(line.strip().split(None, 9))
            next(lines, None)
            if len(found[-1]) < 10:
                raise DataError(f"{file}: the line {line[:60]!r} has {len(found[-1])} fields; an image has 10")
    return found


def _suffix(folder: Path) -> str | None:
    return next((end for end in (".bin", ".txt") if (folder / f"images{end}").is_file()), None)


def _part_notes(path: Path, model: Path) -> list[str]:
    others = [part.name for part in sorted(model.parent.glob("*")) if part != model and part.is_dir() and _suffix(part)]
    if model == path or not others:
        return []
    return [f"the model has several parts; the largest, {model.name}, is used, not {listed(others)}"]


def _open(model: Path, suffix: str) -> Any:
    pycolmap = pycolmap_module()
    if suffix == ".bin":
        check_whole(model)
    reconstruction = pycolmap.Reconstruction()
    try:
        if suffix == ".bin":
            reconstruction.read_binary(str(model))
        elif _ALIAS.search(cameras := (model / "cameras.txt").read_text(encoding="utf-8", errors="replace")):
            with tempfile.TemporaryDirectory() as folder:
                for file in model.glob("*.txt"):
                    (Path(folder) / file.name).symlink_to(file.absolute())
                (Path(folder) / "cameras.txt").unlink()
                (Path(folder) / "cameras.txt").write_text(_ALIAS.sub(r"\1EQUIRECTANGULAR \2 \3 \2 \3", cameras))
                reconstruction.read_text(folder)
        else:
            reconstruction.read_text(str(model))
    except (ValueError, IndexError, RuntimeError, OSError) as error:
        raise DataError(f"pycolmap cannot read the COLMAP model {model}: {error}; export the model again") from error
    return reconstruction


def _frame(image: Any, name: str, folder: Path, model: Path) -> Frame:
    camera = image.camera
    if camera.model_name != "EQUIRECTANGULAR":
        raise DataError(
            f"{name} has a {camera.model_name} camera ({model}); only panoramas (EQUIRECTANGULAR) can be used: "
            "reconstruct from the panoramas themselves (`padgs prepare`), or give the sparse_equirectangular model"
        )
    where = f"{name} in {model}"
    checked_quaternion(
        torch.tensor(image.cam_from_world().rotation.quat), where
    )  # pycolmap turns 0 0 0 0 into the identity
    pose = torch.from_numpy(np.asarray(image.cam_from_world().matrix(), np.float64))
    return Frame(
        name=check_inside(name, str(model)),
        image=folder / name,
        cam_from_world=cam_from_world(pose[:, :3], pose[:, 3], where),
        width=camera.width,
        height=camera.height,
    )


def _tracks(images: list[Any], row_of: dict[int, int]) -> Tracks:
    return Tracks.from_observations(
        (frame, row_of[seen.point3D_id], seen.xy)
        for frame, image in enumerate(images)
        for seen in image.get_observation_points2D()
    )


_CAMERA_PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12}  # by model id
_EQUIRECTANGULAR = 17


def check_whole(folder: Path) -> None:
    """Check the structure of all .bin files of a model folder.

    pycolmap does not return from some truncated files, because it reserves as many points as garbage says. Source: the
    description of COLMAP's output format, 3.x and 4.x.

    Raises:
        DataError: a file is truncated, or longer than its entries.
    """
    for stem, skip in _ENTRIES.items():
        path = folder / f"{stem}.bin"
        if not path.is_file():
            continue
        data = path.read_bytes()
        try:
            (count,) = struct.unpack_from("<Q", data)
            if count > len(data):  # every entry has more than one byte
                raise struct.error
            offset = 8
            for _ in range(count):
                offset = skip(data, offset)
        except (struct.error, ValueError) as error:
            raise DataError(
                f"{path} ends early or is not a COLMAP {stem} file; copy it again or rebuild the model"
            ) from error
        if offset != len(data):
            raise DataError(f"{path} has {len(data)} bytes but its {count} entries take {offset}; copy it again")


def _advance(data: bytes, offset: int, size: int) -> int:
    if offset + size > len(data):
        raise struct.error
    return offset + size


def _skip_camera(data: bytes, offset: int) -> int:
    (model,) = struct.unpack_from("<4xi", data, offset)
    if model not in _CAMERA_PARAMETERS and model != _EQUIRECTANGULAR:
        raise DataError(
            f"the model holds a camera of type {model}; only EQUIRECTANGULAR ({_EQUIRECTANGULAR}) can be used here"
        )
    return _advance(data, offset, 24 + 8 * _CAMERA_PARAMETERS.get(model, 2))


def _skip_image(data: bytes, offset: int) -> int:
    offset = data.index(b"\0", _advance(data, offset, 64)) + 1
    (count,) = struct.unpack_from("<Q", data, offset)
    return _advance(data, offset, 8 + 24 * count)


def _skip_point(data: bytes, offset: int) -> int:
    (length,) = struct.unpack_from("<43xQ", data, offset)
    return _advance(data, offset, 51 + 8 * length)


def _skip_rig(data: bytes, offset: int) -> int:
    (sensors,) = struct.unpack_from("<4xI", data, offset)
    offset = _advance(data, offset, 16 if sensors else 8)
    for _ in range(max(0, sensors - 1)):
        (posed,) = struct.unpack_from("<8xB", data, offset)
        offset = _advance(data, offset, 65 if posed else 9)
    return offset


def _skip_frame(data: bytes, offset: int) -> int:
    (count,) = struct.unpack_from("<64xI", data, offset)
    return _advance(data, offset, 68 + 16 * count)


_ENTRIES: dict[str, Callable[[bytes, int], int]] = {
    "cameras": _skip_camera,
    "images": _skip_image,
    "points3D": _skip_point,
    "rigs": _skip_rig,
    "frames": _skip_frame,
}
