"""Files of COLMAP models, text and binary. Source: the description of COLMAP's output format, 3.x and 4.x.

A damaged file is a DataError: it names the line of a text, or says that a binary file is truncated or too long.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from padgs.data.capture import Cloud, DataError, by_id, first_of
from padgs.data.cloud import color_bytes, whole_if_possible
from padgs.data.images import read_bytes
from padgs.data.splits import read_lines

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

    model: str  # its name, or "type ID" in binary files
    width: int
    height: int
    params: tuple[float, ...] = ()  # of a SPHERE and of cameras that are no panoramas


@dataclass(frozen=True)
class Image:
    """An entry of the images file."""

    id: int
    pose: tuple[float, ...]  # quaternion w x y z, then translation; cam from world
    camera: int
    name: str
    pixels: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))  # [K, 2] observations
    points: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))  # [K] their point ids


def find_file(model: Path, stem: str) -> Path | None:
    """Return a file of a model, binary or text; None if it has neither."""
    return first_of(model, (f"{stem}.bin", f"{stem}.txt"))


def read_cameras(file: Path) -> Iterator[tuple[int, Camera]]:
    """Read the cameras file: id and camera."""
    if file.suffix.lower() == ".txt":
        for number, line in _lines(file):
            words, kinds = line.split(), (int, str, int, int)
            key, model, width, height = _fields(file, number, words, kinds, "ID MODEL WIDTH HEIGHT")
            model = model.upper()
            names, params = "PARAMS", words[4:] if model not in PANORAMIC else []
            if model == "SPHERE":
                names, params = "F CX CY", (words[4:] + 3 * [""])[:3]
            params = _fields(file, number, params, (float,) * len(params), f"{names} after ID MODEL WIDTH HEIGHT")
            yield key, Camera(model, width, height, tuple(params))
        return

    def entry(cursor: _Cursor) -> tuple[int, Camera]:
        key, model, width, height = cursor.take("IiQQ")
        if model not in PARAMETERS:
            raise DataError(f"{file} holds a camera of type {model}, which no version of COLMAP has; export it again")
        center = struct.pack("<2d", width / 2, height / 2)
        is_sphere = model == SPHERE and cursor.data[cursor.offset + 8 : cursor.offset + 24] == center
        params = cursor.take(f"{3 if is_sphere else PARAMETERS[model]}d")
        if is_sphere or model == EQUIRECTANGULAR:
            return key, Camera(PANORAMIC[0], width, height)
        return key, Camera(f"type {model}", width, height, params)

    yield from _entries(file, entry)


def read_images(file: Path) -> Iterator[Image]:
    """Read the images file. In text, the line of observations after an image may be empty or missing."""
    if file.suffix.lower() == ".txt":
        kinds, image = (int, *[float] * 7, int, str), None
        for number, line in _lines(file):
            seen = _observations(line) if image else None
            points = "X Y POINT3D for each point of the image above, nor " if image else ""
            if image:
                yield image if seen is None else replace(image, pixels=seen[:, :2], points=seen[:, 2].astype(np.int64))
                image = None
            if seen is None:
                names = f"{points}ID QW QX QY QZ TX TY TZ CAMERA NAME"
                fields = _fields(file, number, line.split(None, 9), kinds, names)
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
    """Read the points file: point id -> row of the cloud, and the cloud."""
    if file.suffix.lower() == ".txt":
        kinds, rows = (int, *[float] * 6), []
        for number, line in _lines(file):
            rows.append(_fields(file, number, line.split()[:7], kinds, "ID X Y Z R G B"))
    else:

        def entry(cursor: _Cursor) -> tuple[Any, ...]:
            values = cursor.take("Q3d3B8x")
            cursor.array([("image", "<u4"), ("observation", "<u4")])  # the track
            return values

        rows = _entries(file, entry)
    rows = [row for _, row in sorted(by_id(((row[0], row) for row in rows), str(file)).items())]
    values = np.array([row[1:] for row in rows], np.float64).reshape(-1, 6)
    colors = color_bytes(whole_if_possible(values[:, 3:]), str(file))
    cloud = Cloud(torch.from_numpy(values[:, :3].copy()), colors)
    return {row[0]: i for i, row in enumerate(rows)}, cloud


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text file that are neither empty nor comments, with their numbers."""
    errors = "surrogateescape" if file.stem.lower() == "images" else "replace"  # names are refused later, with advice
    for number, line in enumerate(read_lines(file, errors), 1):
        if line.strip() and not line.strip().startswith("#"):
            yield number, line.strip()


def _fields(file: Path, number: int, fields: list[str], kinds: tuple[type, ...], names: str) -> list[Any]:
    try:
        if any("_" in field for kind, field in zip(kinds, fields, strict=False) if kind is not str):
            raise ValueError("Python takes 7_3 for 73, other programs do not")
        return [kind(field) for kind, field in zip(kinds, fields[: len(kinds)], strict=True)]
    except ValueError as error:
        raise DataError(f"{file}, line {number}: {' '.join(fields)[:60]!r} is not {names}; export it again") from error


def _observations(line: str) -> NDArray[np.float64] | None:
    """Return observations [K, 3] (x, y, point), or None if the line is not of observations."""
    try:
        seen = np.array(line.split(), np.float64).reshape(-1, 3)
    except ValueError:
        return None
    return seen if (seen[:, 2] == np.rint(seen[:, 2])).all() else None


class _Cursor:
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
    """Read the entries of a binary file; a DataError if it is truncated, or longer than its entries."""
    cursor, found = _Cursor(file), list[T]()
    try:
        (count,) = cursor.take("Q")
        half = count / 2 if file.stem.lower() == "images" else None  # of what COLMAP's pull request 4295 mends
        while len(found) < count and not (len(found) == half and cursor.offset == len(cursor.data)):
            found.append(entry(cursor))
    except (struct.error, IndexError, OverflowError) as error:
        raise DataError(f"{file} ends early or is not a COLMAP file; copy it again or rebuild the model") from error
    if cursor.offset != len(cursor.data):
        raise DataError(f"{file} has {len(cursor.data)} bytes, its {count} entries take {cursor.offset}; copy it again")
    return found
