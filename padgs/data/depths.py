"""Depth maps of views: NPY, EXR, TIFF and 16-bit PNG files, read as distance along the ray in world units.

0 and NaN are unknown, infinity is sky. A format states what its files hold; a `depths/` folder of your own states it in
`depth.json`, as `padgs render --depth` writes it: {"measure": a key of MEASURES, "unit": world units of one step}.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from padgs.data.capture import Capture, DataError, DataOptions, DepthMeaning, first_of, listed
from padgs.data.images import read_bytes, refused_if_damaged
from padgs.data.scans import optional_module
from padgs.files import folded, open_image
from padgs.scene import View

FOLDERS = ("depths", "depth")
STATEMENT = "depth.json"
EXTENSIONS = (".npy", ".exr", ".png", ".tif", ".tiff")
MEASURES = {
    "ray": "distance along the ray",
    "z": "distance along the axis of the camera",
    "relative": "distance along the ray up to scale and shift of its inverse",
    "disparity": "inverse distance up to scale and shift",
}
RELATIVE = ("relative", "disparity")  # as of networks that see one image
SKY = 1e9  # steps; Blender writes 1e10 where there is nothing
HOW = (
    'write {"measure": "ray", "unit": 1} into it: ray is the distance along the ray, z that along the axis of the '
    "camera, relative and disparity (its inverse) what networks estimate from one image, unit the world units of one "
    "step; or set data.depth=none"
)


@dataclass(frozen=True)
class Depth:
    """The depth map of one view; used as `View.load_depth`."""

    file: Path
    meaning: DepthMeaning
    view: View
    values: NDArray[np.float32] | None = None  # of the file, if they are held in memory

    def __call__(self) -> Tensor:
        """Return the distance along the ray [H, W] in world units; 0 is unknown, infinity sky. Nearest samples."""
        height, width = self.view.height, self.view.width
        values = read_depth(self.file) if self.values is None else self.values
        if values.shape != (height, width):
            rows, columns = ((np.arange(n) + 0.5) * s / n for n, s in zip((height, width), values.shape, strict=True))
            values = values[rows.astype(int)[:, None], columns.astype(int)]
        steps = torch.from_numpy(values)
        if self.meaning.measure == "disparity":
            steps = torch.where(steps >= 0, 1 / steps, 0)
        depth = torch.where(steps >= SKY, math.inf, steps.nan_to_num(0, posinf=math.inf).clamp(min=0))
        depth = depth * self.meaning.unit
        if self.meaning.measure == "z":
            ahead = self.view.camera.rays()[..., 2]
            depth = torch.where(ahead > 0, depth / ahead.clamp(min=1e-6), 0)
        return depth


def with_depths(views: list[View], capture: Capture, options: DataOptions) -> tuple[list[View], list[str], list[str]]:
    """Return the views of the capture's frames with `load_depth`, digests of the files, and notes.

    Maps are held in memory if all fit into `cache_bytes`; else they are read on each access. A DataError says that a
    file is of unknown meaning, damaged, of another shape than its view, or without a known distance.
    """
    files, meaning, notes = ({}, None, []) if options.depth == "none" else _depth_files(capture)
    if meaning is None:
        return views, [], notes
    made, digests, sizes, total = list(views), [f"{meaning.measure}{meaning.unit}"], set(), 0
    for i, (view, frame) in enumerate(zip(views, capture.frames, strict=True)):
        if (file := files.get(frame.name)) is None:
            continue
        if meaning.measure == "z" and view.lens is None:
            raise DataError(
                f"{file} holds z (by {meaning.source}), but {frame.name} is a panorama, which has no such axis; "
                "convert it to the distance along the ray, or set data.depth=none"
            )
        values = read_depth(file)
        height, width = values.shape
        if width * view.height != height * view.width:
            differ = f"{file} is {width}x{height}, and {frame.name} is {view.width}x{view.height}"
            raise DataError(f"{differ}; a depth map must have the shape of its image, in any size")
        if not (np.isfinite(values) & (values > 0) & (values < SKY)).any():
            raise DataError(f"{file} holds no distance above 0; remove it, or set data.depth=none")
        sizes.add(f"{width}x{height}")
        digests.append(f"{frame.name}:{hashlib.sha256(read_bytes(file)).hexdigest()}")
        total += values.nbytes
        depth = Depth(file, meaning, view, values if total <= options.cache_bytes else None)
        made[i] = replace(view, load_depth=depth, depth_is_relative=meaning.measure in RELATIVE)
    what = MEASURES[meaning.measure]
    what += "" if meaning.measure in RELATIVE else f" in steps of {meaning.unit:g} world units"
    note = f"depth: {len(files)} of {len(views)} views, {listed(sorted(sizes))}, {what} (by {meaning.source})"
    return made, digests, [note]


def read_depth(file: Path) -> NDArray[np.float32]:
    """Read the numbers of a depth map, [H, W]; a DataError for a damaged or 8-bit file, or for channels that differ."""
    data = read_bytes(file)
    with refused_if_damaged(file):
        if file.suffix.lower() == ".npy":
            values = np.lib.format.read_array(BytesIO(data), allow_pickle=False)
        elif file.suffix.lower() == ".exr":
            values = _exr(file)
        else:
            image = open_image(BytesIO(data), file)
            if not image.mode.startswith(("I", "F")):
                raise DataError(f"{file} has pixels of type {image.mode}; a depth map needs 16 bits, in one channel")
            values = np.asarray(image)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2 or not values.size or values.dtype.kind not in "fiu":
        kind = f"{values.dtype} {list(values.shape)}"
        raise DataError(f"{file} is an array of {kind}; it must be [height, width] numbers")
    return values.astype(np.float32)


def _exr(file: Path) -> NDArray:
    """Read the single channel of an EXR file, or one of three that are equal, as Blender writes depth."""
    try:
        channels = optional_module("OpenEXR", file, "exr").File(str(file), separate_channels=True).channels()
        pixels = {name: np.asarray(channel.pixels) for name, channel in channels.items() if name != "A"}
    except RuntimeError as error:
        raise DataError(f"{file} is no usable EXR file ({error}); export it again") from error
    depths = [values for name, values in pixels.items() if name.rpartition(".")[2] == "Z"]  # beside a picture
    first, *others = depths if len(depths) == 1 else pixels.values()
    if not all(np.array_equal(first, other, equal_nan=True) for other in others):
        raise DataError(f"{file} holds the channels {listed(pixels)}, which differ; a depth map has one")
    return first


def _depth_files(capture: Capture) -> tuple[dict[str, Path], DepthMeaning | None, list[str]]:
    """Return depth files by frame, what they hold, and notes; they are the format's, or lie in a `depths/` folder."""
    if capture.depth is not None:
        named = {frame.name: frame.depth for frame in capture.frames if frame.depth is not None}
        if absent := [path for path in named.values() if not path.is_file()]:
            lost = f"{len(absent)} depth maps of {capture.format} do not exist ({listed(absent)})"
            raise DataError(f"{lost}; copy them, or set data.depth=none")
        return named, capture.depth if named else None, []
    notes: list[str] = []
    usual = (first_of(base, (name,), Path.is_dir) for base in capture.places for name in FOLDERS)
    for folder in dict.fromkeys(folder for folder in usual if folder):
        inside = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.startswith(".")]
        maps = [path for end in reversed(EXTENSIONS) for path in inside if path.suffix.lower() == end]  # the best last
        there = {folded(path.relative_to(folder).with_suffix("")): path for path in maps}
        files = {}
        for frame in capture.frames:
            image = PurePosixPath(frame.name)
            names = (image.stem, image.name, f"{image.stem}_depth", f"depth_{image.stem}")
            keys = (folded(image.with_name(name)) for name in names)
            if found := next((there[key] for key in keys if key in there), None):
                files[frame.name] = found
        if files and (folder / STATEMENT).is_file():
            return files, _stated(folder / STATEMENT, any(map(_may_be_whole, files.values()))), notes
        if files:  # maybe previews, or of another program
            notes.append(f"depth: {folder} is not used: no {STATEMENT} says what its maps hold; to use them, {HOW}")
        elif there:
            examples = f"{next(iter(there.values())).name} for {capture.frames[0].name}"
            notes.append(f"depth: none of the {len(there)} maps in {folder} is named like an image, such as {examples}")
        elif inside:
            notes.append(f"depth: {folder} holds no {', '.join(EXTENSIONS)}, such as {inside[0].name}; it is not used")
    others = (path.name for path in sorted(capture.folder.glob("*")) if path.is_dir() and "depth" in path.name.lower())
    notes += [f"depth: {name}/ is not used; name it depths/" for name in others if name.lower() not in FOLDERS]
    return {}, None, notes


def _may_be_whole(file: Path) -> bool:
    if file.suffix.lower() != ".npy":
        return file.suffix.lower() != ".exr"
    with refused_if_damaged(file):
        return np.lib.format.open_memmap(file, mode="r").dtype.kind in "iu"


def _stated(file: Path, may_be_whole: bool) -> DepthMeaning:
    """Read what the maps of a folder hold; the steps of integers have no usual unit."""
    try:
        stated = json.loads(read_bytes(file))
        measure = stated["measure"]
        unit = stated["unit"] if may_be_whole and measure not in RELATIVE else stated.get("unit", 1)
        if measure not in MEASURES or isinstance(unit, bool) or not 0 < float(unit) < math.inf:
            raise ValueError(f"measure is {measure!r} and unit {unit!r}")
    except (ValueError, TypeError, KeyError, RecursionError, AttributeError, OverflowError) as error:
        raise DataError(f"{file} does not say what the depth maps hold ({error}); {HOW}") from error
    return DepthMeaning(measure, float(unit), file.name)


def write_depths(views: Sequence[View], folder: Path, unit: float = 1.0) -> None:
    """Write the depth maps of views, if any has one, into `depths/` of a folder whose world has `unit` per unit."""
    known = [view for view in views if view.load_depth is not None]
    for view in known:
        assert view.load_depth is not None
        file = folder / FOLDERS[0] / f"{view.name}.npy"
        file.parent.mkdir(parents=True, exist_ok=True)
        np.save(file, view.load_depth().numpy())
    if known:
        measure = RELATIVE[0] if known[0].depth_is_relative else "ray"
        (folder / FOLDERS[0] / STATEMENT).write_text(json.dumps({"measure": measure, "unit": unit}))
