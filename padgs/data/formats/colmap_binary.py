"""Whether the files of a binary COLMAP model are whole.

pycolmap does not return from some truncated files (it tries to reserve as many points as garbage tells it), so their
structure is walked through first. Layout: COLMAP's documentation of its output format, 3.x and 4.x.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from padgs.data.errors import DataError

_CAMERA_PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12}  # by model id
_EQUIRECTANGULAR = 17


def check_whole(folder: Path) -> None:
    """Walk through all .bin files of a model folder.

    Raises:
        DataError: a file ends early, or goes on after its last entry.
    """
    for stem, skip in _ENTRIES.items():
        path = folder / f"{stem}.bin"
        if not path.is_file():
            continue
        data = path.read_bytes()
        try:
            (count,) = struct.unpack_from("<Q", data)
            if count > len(data):  # every entry takes more than a byte
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


def _skip(data: bytes, offset: int, size: int) -> int:
    if offset + size > len(data):
        raise struct.error
    return offset + size


def _camera(data: bytes, offset: int) -> int:
    (model,) = struct.unpack_from("<4xi", data, offset)
    if model not in _CAMERA_PARAMETERS and model != _EQUIRECTANGULAR:
        raise DataError(
            f"the model holds a camera of type {model}; only EQUIRECTANGULAR ({_EQUIRECTANGULAR}) can be used here"
        )
    return _skip(data, offset, 24 + 8 * _CAMERA_PARAMETERS.get(model, 2))


def _image(data: bytes, offset: int) -> int:
    offset = data.index(b"\0", _skip(data, offset, 64)) + 1
    (count,) = struct.unpack_from("<Q", data, offset)
    return _skip(data, offset, 8 + 24 * count)


def _point(data: bytes, offset: int) -> int:
    (length,) = struct.unpack_from("<43xQ", data, offset)
    return _skip(data, offset, 51 + 8 * length)


def _rig(data: bytes, offset: int) -> int:
    (sensors,) = struct.unpack_from("<4xI", data, offset)
    offset = _skip(data, offset, 16 if sensors else 8)
    for _ in range(max(0, sensors - 1)):
        (posed,) = struct.unpack_from("<8xB", data, offset)
        offset = _skip(data, offset, 65 if posed else 9)
    return offset


def _frame(data: bytes, offset: int) -> int:
    (count,) = struct.unpack_from("<64xI", data, offset)
    return _skip(data, offset, 68 + 16 * count)


_ENTRIES: dict[str, Callable[[bytes, int], int]] = {
    "cameras": _camera,
    "images": _image,
    "points3D": _point,
    "rigs": _rig,
    "frames": _frame,
}
