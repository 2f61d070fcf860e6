"""COLMAP models, text or binary, of EQUIRECTANGULAR cameras (in forks: SPHERICAL or SPHERE).

COLMAP's panoramic camera has the axes of `padgs.geometry.panorama`, so poses are used unchanged: those of the images
file, which all versions write. Source: the description of COLMAP's output format, 3.x and 4.x.
"""

from __future__ import annotations

import signal
import struct
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, Cloud, DataError, DataOptions, Frame, Tracks, color_bytes, listed
from padgs.data.formats.poses import cam_from_world, rotation_from_quaternion
from padgs.data.images import read_bytes
from padgs.data.splits import check_inside, read_lines

FILES = ("cameras", "images", "points3D")
PANORAMIC = ("EQUIRECTANGULAR", "SPHERICAL", "SPHERE")
EQUIRECTANGULAR = 17  # id of the camera model in binary files
SPHERE = 11  # its id in SphereSfM; in COLMAP a camera with 16 parameters
PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12, 11: 16, 12: 4, 13: 5, 14: 3, 15: 4}
PARAMETERS |= {16: 6, EQUIRECTANGULAR: 2}  # numbers of parameters of the camera models

T = TypeVar("T")


@dataclass(frozen=True)
class Camera:
    """An entry of the cameras file."""

    model: str
    width: int
    height: int


@dataclass(frozen=True)
class Image:
    """An entry of the images file."""

    id: int
    pose: tuple[float, ...]  # quaternion w x y z, then translation; cam from world
    camera: int
    name: str
    pixels: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))  # [K, 2] observations
    points: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))  # [K] their point ids


def find_model(path: Path) -> Path | None:
    """Find the folder with the model's files, in a data set's folder or itself; the largest of several parts."""
    for folder in (path / "sparse_equirectangular", path / "sparse", path / "colmap" / "sparse", path):
        parts = [folder, *sorted(part for part in folder.glob("*") if part.is_dir())] if folder != path else [folder]
        sizes = {part: file.stat().st_size for part in parts if (file := _file(part, "images"))}
        if sizes:
            return max(sizes, key=lambda part: sizes[part])
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
    files = [file for name in FILES if (file := _file(model, name))]
    absent = sorted(set(FILES) - {file.stem for file in files})
    if absent:
        raise DataError(f"the COLMAP model {model} lacks {listed(absent)} (.bin or .txt); export the whole model")
    folder = image_folder(path, options.images)
    cameras = dict(read_cameras(files[0]))
    images = sorted(read_images(files[1]), key=lambda image: image.id)
    row_of, cloud = read_points(files[2])
    return Capture(
        format="colmap",
        folder=path,
        image_folder=folder,
        frames=tuple(_frame(image, cameras.get(image.camera), folder, model) for image in images),
        cloud=cloud,
        tracks=lambda: _tracks(images, row_of),
        notes=tuple(_part_notes(path, model)),
    )


def pycolmap_module() -> ModuleType:
    """Import pycolmap without breaking PNG files of Pillow and the handler of SIGTERM."""
    import zlib  # noqa: F401 - first, or pycolmap's deflate symbols replace the system's

    import pycolmap

    if threading.current_thread() is threading.main_thread():  # the handler of its library calls SIGTERM a crash
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
    return pycolmap


def read_cameras(file: Path) -> Iterator[tuple[int, Camera]]:
    """Read the cameras file: id and camera."""
    if file.suffix == ".txt":
        for number, line in _lines(file):
            kinds = (int, str, int, int)
            key, model, width, height, *_ = _fields(file, number, line.split(), kinds, "ID MODEL WIDTH HEIGHT")
            yield key, Camera(model, width, height)
        return

    def entry(cursor: _Cursor) -> tuple[int, Camera]:
        key, model, width, height = cursor.take("IiQQ")
        if model not in PARAMETERS:
            raise DataError(f"{file} holds a camera of type {model}; only EQUIRECTANGULAR (17) can be used here")
        center = struct.pack("<2d", width / 2, height / 2)
        is_sphere = model == SPHERE and cursor.data[cursor.offset + 8 : cursor.offset + 24] == center
        cursor.take("24x" if is_sphere else f"{8 * PARAMETERS[model]}x")
        return key, Camera(PANORAMIC[0] if is_sphere or model == EQUIRECTANGULAR else f"type {model}", width, height)

    yield from _entries(file, entry)


def read_images(file: Path) -> Iterator[Image]:
    """Read the images file. In text, the line of observations after an image may be empty or missing.

    Raises:
        DataError: a damaged file; the message names the line.
    """
    if file.suffix == ".txt":
        kinds, image = (int, *[float] * 7, int, str), None
        for number, line in _lines(file):
            seen = _observations(line) if image else None
            if image:
                yield image if seen is None else replace(image, pixels=seen[:, :2], points=seen[:, 2].astype(np.int64))
                image = None
            if seen is None:
                fields = _fields(file, number, line.split(None, 9), kinds, "ID QW QX QY QZ TX TY TZ CAMERA NAME")
                image = Image(fields[0], tuple(fields[1:8]), *fields[8:])
        if image:
            yield image
        return

    def entry(cursor: _Cursor) -> Image:
        key, *pose, camera = cursor.take("I7dI")
        name = cursor.text()
        seen = cursor.array([("pixel", "<f8", 2), ("point", "<i8")])
        return Image(key, tuple(pose), camera, name, seen["pixel"], seen["point"])

    yield from _entries(file, entry)


def read_points(file: Path) -> tuple[dict[int, int], Cloud]:
    """Read the points file: the cloud, and the row of each point id."""
    if file.suffix == ".txt":
        kinds = (int, *[float] * 6)
        rows = [_fields(file, number, line.split(), kinds, "ID X Y Z R G B") for number, line in _lines(file)]
    else:

        def entry(cursor: _Cursor) -> tuple[Any, ...]:
            values = cursor.take("Q3d3B8x")
            cursor.array([("image", "<u4"), ("observation", "<u4")])
            return values

        rows = list(_entries(file, entry))
    rows.sort(key=lambda row: row[0])
    values = torch.tensor([row[1:] for row in rows], dtype=torch.float64).reshape(-1, 6)
    return {row[0]: i for i, row in enumerate(rows)}, Cloud(values[:, :3], color_bytes(values[:, 3:], str(file)))


def pose_of(image: Image, where: str) -> Tensor:
    """Return cam_from_world [4, 4] of an image; `where` names it in errors."""
    pose = torch.tensor(image.pose, dtype=torch.float64)
    return cam_from_world(rotation_from_quaternion(pose[:4], where), pose[4:], where)


def _file(model: Path, stem: str) -> Path | None:
    return next((file for end in (".bin", ".txt") if (file := model / f"{stem}{end}").is_file()), None)


def _part_notes(path: Path, model: Path) -> list[str]:
    others = [part.name for part in sorted(model.parent.glob("*")) if part != model and _file(part, "images")]
    if model == path or not others:
        return []
    return [f"the model has several parts; the largest, {model.name}, is used, not {listed(others)}"]


def _frame(image: Image, camera: Camera | None, folder: Path, model: Path) -> Frame:
    name = check_inside(image.name, str(model))
    if camera is None or camera.model not in PANORAMIC:
        raise DataError(
            f"{name} has a {camera.model if camera else 'missing'} camera ({model}); only panoramas "
            "(EQUIRECTANGULAR) can be used: reconstruct from the panoramas themselves (`padgs prepare`), or give the "
            "sparse_equirectangular model"
        )
    return Frame(name, folder / name, pose_of(image, f"{name} in {model}"), camera.width, camera.height)


def _tracks(images: list[Image], row_of: dict[int, int]) -> Tracks:
    """Return the observations of points that exist."""
    return Tracks.from_observations(
        (frame, row_of[point], pixel)
        for frame, image in enumerate(images)
        for point, pixel in zip(image.points.tolist(), image.pixels, strict=True)
        if point in row_of
    )


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text file that are neither empty nor comments, with their numbers."""
    for number, line in enumerate(read_lines(file, errors="surrogateescape"), 1):
        if line.strip() and not line.startswith("#"):
            yield number, line.strip()


def _fields(file: Path, number: int, fields: list[str], kinds: tuple[type, ...], names: str) -> list[Any]:
    try:
        return [kind(field) for kind, field in zip(kinds, fields[: len(kinds)], strict=True)]
    except ValueError as error:
        raise DataError(f"{file}, line {number}: {' '.join(fields)[:60]!r} is not {names}; export it again") from error


def _observations(line: str) -> NDArray[np.float64] | None:
    """Return observations [K, 3] (x, y, point), or None if the line is not of observations."""
    try:
        return np.array(line.split(), np.float64).reshape(-1, 3)
    except ValueError:
        return None


class _Cursor:
    """Position in a binary file."""

    def __init__(self, file: Path) -> None:
        self.data, self.offset = read_bytes(file), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        values = struct.unpack_from(f"<{layout}", self.data, self.offset)
        self.offset += struct.calcsize(f"<{layout}")
        return values

    def text(self) -> str:
        start, self.offset = self.offset, self.data.find(b"\0", self.offset) + 1 or len(self.data)
        return self.data[start : self.offset - 1].decode("utf-8", "surrogateescape")

    def array(self, dtype: list[Any]) -> NDArray[Any]:
        """Read a number of entries, then the entries."""
        (count,) = self.take("Q")
        if count > len(self.data):
            raise IndexError
        whole = self.data[self.offset : self.offset + count * np.dtype(dtype).itemsize]
        self.take(f"{count * np.dtype(dtype).itemsize}x")
        return np.frombuffer(whole, dtype)


def _entries(file: Path, entry: Callable[[_Cursor], T]) -> list[T]:
    """Read the entries of a binary file.

    Raises:
        DataError: the file is truncated, or longer than its entries.
    """
    cursor = _Cursor(file)
    try:
        (count,) = cursor.take("Q")
        found = [entry(cursor) for _ in range(count)]
    except (struct.error, IndexError, OverflowError) as error:
        raise DataError(f"{file} ends early or is not a COLMAP file; copy it again or rebuild the model") from error
    if cursor.offset != len(cursor.data):
        raise DataError(
            f"{file} has {len(cursor.data)} bytes but its {count} entries take {cursor.offset}; copy it again"
        )
    return found
