"""Data structures shared by all readers, the `data` options, and `DataError`.

Every file format has one reader, `read(path, options) -> Capture`; `padgs.data.assemble` turns that into a scene, and
`padgs.data.formats.convert` writes it in another format.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from padgs.checks import unknown
from padgs.files import IMAGE_FOLDERS
from padgs.geometry.camera import Camera

Progress = Callable[[int, int], None]  # called with (done, total)
EVERY = 8  # of so many views one is a test view, where no list says which
FARTHEST = 1e15  # world units from the origin, the limit of renderers (`padgs.render.contract`)
OTHERS = "also present, not used"  # words of a note about files of other formats


class DataError(ValueError):
    """Unusable input. The message names the file, the rule and the way out; no traceback is needed."""


def listed(names: Iterable[object], most: int = 5) -> str:
    """Join the first names and say how many more there are.

    >>> listed("abcdefg", most=3)
    'a, b, c and 4 more'
    """
    names = [str(name) for name in names]
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def by_id(pairs: Iterable[tuple[Any, Any]], where: str) -> dict[Any, Any]:
    """Return pairs of id and value as a dictionary; a DataError if `where` has an id twice, with different values.

    >>> by_id([(1, "a"), (2, "b"), (1, "a")], "cameras.txt")
    {1: 'a', 2: 'b'}
    """
    found: dict[Any, Any] = {}
    for key, value in pairs:
        if found.setdefault(key, value) != value:
            raise DataError(f"{where} has {key!r} twice, with different values; remove one, or export it again")
    return found


def refuse_special(path: Path) -> None:
    """Refuse folders, pipes and devices in place of a file: reading a pipe waits, and some devices never end."""
    if path.exists() and not path.is_file():
        raise DataError(f"{path} cannot be read: it is no regular file; replace or remove it")


def files_with(folder: Path, suffix: str) -> list[Path]:
    """Return the files in a folder with a suffix in any case, sorted, without hidden ones."""
    files = (file for file in folder.glob("*") if file.suffix.lower() == suffix and not file.name.startswith("."))
    return sorted(file for file in files if file.is_file())


def first_of(folder: Path, names: Iterable[str], kind: Callable[[Path], bool] = Path.is_file) -> Path | None:
    """Return what has the first of the names in a folder, in any case, and is of a kind; None if there is none."""
    there = {path.name.casefold(): path for path in sorted(folder.glob("*")) if kind(path)}
    return next((there[name.casefold()] for name in names if name.casefold() in there), None)


def natural_key(name: str) -> tuple[list[Any], str]:
    """Return a sort key that orders numbers in names by value.

    >>> sorted(["view_10", "view_2", "door"], key=natural_key)
    ['door', 'view_2', 'view_10']
    """
    parts: list[Any] = re.split(r"(\d+)", name)
    parts[1::2] = map(int, parts[1::2])
    return parts, name


def view_name(frame_name: str) -> str:
    """Return a view's name: its image's path in the image folder, without extension."""
    return str(PurePosixPath(frame_name).with_suffix(""))


@dataclass(frozen=True)
class UnknownLens:
    """Lens of a photograph that its format does not give, or that is not read: only `data.cameras=panoramas` helps."""

    why: str

    def __call__(self, width: int, height: int) -> Camera:
        """Raise the DataError that says why."""
        raise DataError(f"{self.why}; leave out images of other cameras with data.cameras=panoramas")


@dataclass(frozen=True)
class Frame:
    """A posed panorama, or a photograph of another camera."""

    name: str  # path relative to the image folder, with its extension, "/" between folders
    image: Path
    cam_from_world: Tensor  # [4, 4] float64, rigid; x right, y down, z forward
    width: int | None = None  # of the camera in pixels, if the format states it
    height: int | None = None
    mask: Path | None = None  # if the format names one
    depth: Path | None = None  # if the format names one
    share: float = 1.0  # of `padgs.scene.View`
    lens: Callable[[int, int], Camera] | None = None  # camera of a photograph at a width and height; None: a panorama


@dataclass(frozen=True)
class Cloud:
    """A point cloud in the world frame."""

    points: Tensor  # [P, 3] float64
    colors: Tensor | None  # [P, 3] uint8


@dataclass(frozen=True)
class Tracks:
    """Observations: `pixels[i]` in frame `frame[i]` shows point `point[i]`."""

    frame: Tensor  # [T] int64, index into Capture.frames
    point: Tensor  # [T] int64, index into Cloud.points
    pixels: Tensor  # [T, 2] float64, continuous (u, v) at the camera's size

    @classmethod
    def from_observations(cls, observations: Iterable[tuple[int, int, Any]]) -> Tracks:
        """Build tracks from (frame, point, pixel) triples; pixels that are not finite are left out."""
        rows = list(observations)
        pixels = np.array([pixel for _, _, pixel in rows], np.float64).reshape(-1, 2)
        ids = np.array([row[:2] for row in rows], np.int64).reshape(-1, 2)
        frame, point = torch.from_numpy(ids[finite := np.isfinite(pixels).all(1)].T.copy())
        return cls(frame, point, torch.from_numpy(pixels[finite]))

    def at(self, some: slice | Tensor) -> Tracks:
        """Return some of the observations."""
        return Tracks(self.frame[some], self.point[some], self.pixels[some])


class DepthMeaning(NamedTuple):
    """Meaning of the numbers of depth maps; see `padgs.data.depths`."""

    measure: str  # a key of `padgs.data.depths.MEASURES`
    unit: float  # world units of one step
    source: str  # that states it


class Reading(NamedTuple):
    """One way to understand what the files of a format leave open."""

    words: str
    axes: Tensor  # [4, 4]; poses are `axes @ cam_from_world`
    world: Tensor  # [4, 4]; points are those of the cloud under this affine map


@dataclass(frozen=True)
class Capture:
    """Contents of a data set before its images are read."""

    format: str
    folder: Path  # of the data set, or of the file that describes it
    image_folder: Path
    frames: tuple[Frame, ...]
    cloud: Cloud | None
    split: Mapping[str, tuple[str, ...]] | None = None  # "train", "test" -> names, if the format states them
    mask: str = "auto"  # meaning of data.mask=auto
    width: int | None = None  # wider images are reduced to it if data.width is null; None = as stored
    tracks: Callable[[], Tracks] | None = None
    notes: tuple[str, ...] = ()
    depth: DepthMeaning | None = None  # of the frames' depth maps
    name: str | None = None  # of the scene, if it is not that of the folder
    readings: tuple[Reading, ...] = ()  # the first is the usual one; see `padgs.data.conventions.best_reading`

    @property
    def places(self) -> tuple[Path, ...]:
        """Return the folders of masks, depth maps and lists: that of the data set, and that around its images."""
        images = Path(os.path.abspath(self.image_folder))  # of "." too
        if self.folder != self.image_folder:
            return tuple(dict.fromkeys((self.folder, self.image_folder.parent)))
        return (images.parent, self.folder) if images.name.lower() in IMAGE_FOLDERS else (self.folder,)


@dataclass(frozen=True)
class DataSettings:
    """The `data` group of the configuration, as far as users set it."""

    dataset: str | None = None  # roam360 | ricoh360 | omniblender | ob3d | tartanair: defines mask, size and source
    width: int | None = None  # panoramas are reduced to this width by an area filter; None = as stored
    images: str | None = None  # image folder, relative to the data set's or to the working folder; None = search
    points: str = "auto"  # auto | random | a PLY, LAS, LAZ or E57 file, relative as `images`
    mask: str = "auto"  # auto | none | inverted (255 = ignore) | rows:959/1024 | [inverted:] a file or folder
    depth: str = "auto"  # auto: depth maps that the format names, or in depths/ with depth.json | none
    cameras: str = "all"  # all | panoramas: leave out photographs of other cameras
    split: str = "auto"  # auto | files (train.txt, test.txt) | every (k-th view) | all (train on everything)
    test_every: int = EVERY  # k of split=every, and of auto without lists
    cache_bytes: int = 1 << 30  # memory for decoded images of all views
    disk_cache: str = "auto"  # auto: keep decoded images on disk if they exceed cache_bytes | off | a folder
    prefetch_threads: int = 2  # threads that decode images in advance; 0 = none
    generator: Mapping[str, Any] = field(default_factory=dict)  # options of the synthetic scene

    def __post_init__(self) -> None:
        known = {"split": ("auto", "files", "every", "all"), "depth": ("auto", "none"), "cameras": ("all", "panoramas")}
        for name, names in known.items():
            if (value := getattr(self, name)) not in names:
                raise DataError(unknown(f"data.{name}", value, names))
        if self.test_every < 2:
            raise DataError(f"data.test_every is {self.test_every}; every k-th view is a test view, with k at least 2")
        if self.width is not None and (self.width < 8 or self.width % 2):
            raise DataError(f"data.width is {self.width}; a panorama is 2:1: give an even number >= 8")
        for name in ("cache_bytes", "prefetch_threads"):
            if getattr(self, name) < 0:
                raise DataError(f"data.{name} is {getattr(self, name)}; it must be 0, which switches it off, or more")


@dataclass(frozen=True)
class DataOptions(DataSettings):
    """The `data` group and the device of the run."""

    device: str = "cpu"  # where decoded images are kept, as uint8
