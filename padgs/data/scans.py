"""Point clouds of scanners: LAS, LAZ and E57, through laspy and pye57, which `padgs[scanners]` installs."""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from padgs.checks import install_command
from padgs.data.capture import Cloud, DataError, refuse_special
from padgs.data.cloud import MOST_POINTS, color_bytes, joined

CHUNK = 1_000_000  # points in memory at a time
CHANNELS = ("red", "green", "blue")


def optional_module(name: str, path: Path, extra: str = "scanners") -> Any:
    """Import the package that reads a file; a DataError says by which extra it is installed."""
    try:
        return import_module(name)
    except ImportError as error:
        needs = f"{name}, which cannot be imported ({error}); install it: {install_command(extra)}"
        raise DataError(f"{path} needs {needs}") from error


def _check_header(path: Path) -> None:
    """Refuse counts beyond the length of a LAS or LAZ file, which laspy would read, or keep memory for, first."""
    length = path.stat().st_size
    with path.open("rb") as file:

        def numbers(form: str, at: int) -> tuple[int, ...]:
            file.seek(at)
            return struct.unpack(form, file.read(struct.calcsize(form)))

        size, start, count = numbers("<HII", 94)
        extended, more = numbers("<QI", 235) if size >= 375 else (0, 0)
        fits = size + 54 * count <= start <= length and (not more or extended + 60 * more <= length)
        if fits and numbers("<B", 104)[0] & 0x80:  # LAZ: the points begin with the place of the table of chunks
            table = numbers("<q", start)[0]
            table = numbers("<q", length - 8)[0] if table == -1 else table
            fits = start <= table <= length - 8 and numbers("<I", table + 4)[0] <= length
    if not fits:
        raise ValueError("its header does not fit its length")


@contextmanager
def _readable(path: Path, again: str) -> Iterator[None]:
    refuse_special(path)
    if not path.exists():
        raise DataError(f"the point cloud {path} does not exist; name it from the data set's folder or from here")
    try:
        yield
    except BaseException as error:  # both packages raise what their libraries raise, and decoders in Rust panic
        is_panic = type(error).__name__ == "PanicException"
        if isinstance(error, DataError) or not (isinstance(error, Exception) or is_panic):
            raise
        why = str(error).partition("\n")[0] or type(error).__name__
        raise DataError(f"{path} is cut short, damaged or of another kind ({why}); {again}") from error


def read_las(path: Path) -> tuple[Cloud, tuple[str, ...]]:
    """Read a LAS or LAZ file, and notes. Colours may have 8 or 16 bits."""
    laspy = optional_module("laspy", path)
    if path.suffix.lower() == ".laz" and not laspy.LazBackend.detect_available():
        optional_module("lazrs", path)
    # Of the decoders of LAZ, the parallel one ends the process if a damaged file states a chunk larger than memory.
    decoders = [decoder for decoder in laspy.LazBackend.detect_available() if decoder.name != "LazrsParallel"]
    points, colors, start = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint16)], 0
    with _readable(path, "export it again as LAS 1.2 to 1.4"):
        _check_header(path)
        with laspy.open(path, laz_backend=decoders) as file:
            step = -(-file.header.point_count // MOST_POINTS) or 1
            coloured = set(CHANNELS) <= set(file.header.point_format.dimension_names)
            for chunk in file.chunk_iterator(CHUNK):
                some = slice(-start % step, None, step)
                points.append(np.stack([np.asarray(chunk[axis]) for axis in "xyz"], axis=1)[some])
                if coloured:
                    colors.append(np.stack([np.asarray(chunk[name]) for name in CHANNELS], axis=1)[some])
                start += len(chunk)
            if start != file.header.point_count:
                raise DataError(f"{path} states {file.header.point_count} points but holds {start}; copy it again")
    paint = color_bytes(np.concatenate(colors), str(path)) if coloured else None
    return _thinned(path, Cloud(torch.from_numpy(np.concatenate(points)), paint), step)


def read_e57_points(path: Path) -> tuple[Cloud, tuple[str, ...]]:
    """Read the points of all scans of an E57 file in the file's common frame, and notes."""
    with open_e57(path) as file:
        headers = [file.get_header(index) for index in range(file.scan_count if file.root.isDefined("data3D") else 0)]
        step = -(-sum(header.point_count for header in headers) // MOST_POINTS) or 1
        cloud, notes = joined([_scan(file, header, step) for header in headers])
    cloud, thinned = _thinned(path, cloud, step)
    return cloud, (*notes, *thinned)


@contextmanager
def open_e57(path: Path) -> Iterator[Any]:
    """Open an E57 file with pye57; errors of its library become a DataError that names the file."""
    pye57 = optional_module("pye57", path)
    with _readable(path, "export it again"):
        file = pye57.E57(str(path))
        try:
            yield file
        finally:
            file.close()


def _scan(file: Any, header: Any, step: int) -> Cloud:
    """Return every `step`-th valid point of a scan in the file's frame."""
    lib, fields = import_module("pye57").libe57, set(header.point_fields)
    spherical = "cartesianX" not in fields
    axes = [f"spherical{name}" for name in ("Range", "Azimuth", "Elevation")]
    axes = axes if spherical else [f"cartesian{axis}" for axis in "XYZ"]
    paint = [f"color{name.title()}" for name in CHANNELS]
    coloured = set(paint) <= fields
    invalid = [name for name in ("cartesianInvalidState", "sphericalInvalidState") if name in fields]
    columns, buffers = {}, lib.VectorSourceDestBuffer()
    for name in [*axes, *(paint if coloured else []), *invalid]:
        columns[name] = np.empty(CHUNK, np.float64)
        buffers.append(lib.SourceDestBuffer(file.image_file, name, columns[name], CHUNK, True, True))
    reader, points, colors, start = header.points.reader(buffers), [np.zeros((0, 3))], [np.zeros((0, 3))], 0
    while count := reader.read():
        some = np.arange(-start % step, count, step)
        for name in invalid:
            some = some[columns[name][some] == 0]
        points.append(np.stack([columns[name][some] for name in axes], axis=1))
        if coloured:
            colors.append(np.stack([columns[name][some] for name in paint], axis=1))
        start += count
    found = np.concatenate(points)
    if spherical:
        radius, azimuth, elevation = found.T
        level = radius * np.cos(elevation)
        found = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), radius * np.sin(elevation)], axis=1)
    if header.has_pose():
        found = file.to_global(found, header.rotation, header.translation)
    if not coloured or not len(found):
        return Cloud(torch.from_numpy(found), None)
    values, kind = np.concatenate(colors), lib.StructureNode(header.points.prototype())[paint[0]]
    if isinstance(kind, lib.IntegerNode):
        fits = (whole for whole in (np.uint8, np.uint16) if kind.maximum() <= np.iinfo(whole).max)
        values = values.astype(next(fits, np.uint32))
    return Cloud(torch.from_numpy(found), color_bytes(values, f"scan {header.guid}"))


def _thinned(path: Path, cloud: Cloud, step: int) -> tuple[Cloud, tuple[str, ...]]:
    return cloud, (f"points: one in {step} of {path.name}, {len(cloud.points)} in all",) if step > 1 else ()
