"""The data structures that readers of formats return, their options, and the error that refuses input."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor


class DataError(ValueError):
    """Input that cannot be used. The message names the file, the rule and the way out; no traceback is needed."""


def listed(names: Iterable[object], most: int = 5) -> str:
    """The first few names and how many more there are.

    >>> listed("abcdefg", most=3)
    'a, b, c and 4 more'
    """
    names = [str(name) for name in names]
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


_NUMBER = re.compile(r"(\d+)")


def natural(name: str) -> tuple[list[Any], str]:
    """What to sort names by so that numbers in them stand by their value.

    >>> sorted(["view_10", "view_2", "door"], key=natural)
    ['door', 'view_2', 'view_10']
    """
    parts: list[Any] = _NUMBER.split(name)
    parts[1::2] = map(int, parts[1::2])
    return parts, name


@dataclass(frozen=True)
class Frame:
    """One posed panorama of a capture."""

    name: str  # path relative to the image folder, with its extension, "/" between folders
    image: Path
    cam_from_world: Tensor  # [4, 4] float64, rigid; x right, y down, z forward
    width: int | None = None  # of the camera, where the format states it
    height: int | None = None
    mask: Path | None = None  # where the format names one


@dataclass(frozen=True)
class Cloud:
    """A point cloud in the world frame."""

    points: Tensor  # [P, 3] float64
    colors: Tensor | None  # [P, 3] uint8


def color_bytes(values: Tensor, where: str) -> Tensor:
    """Colours [P, 3] in 0..255 as uint8; values beyond are cut off.

    Raises:
        DataError: one is not finite.
    """
    if not (finite := values.isfinite().all(1)).all():
        raise DataError(f"the colour of point {(~finite).nonzero()[0].item()} of {where} is not finite; mend the cloud")
    return values.round().clamp(0, 255).to(torch.uint8)


@dataclass(frozen=True)
class Tracks:
    """Observations: point `point[i]` was seen in frame `frame[i]` at `pixels[i]`."""

    frame: Tensor  # [T] int64, index into Capture.frames
    point: Tensor  # [T] int64, index into Cloud.points
    pixels: Tensor  # [T, 2] float64, continuous (u, v) at the camera's size

    @classmethod
    def of(cls, seen: Iterable[tuple[int, int, Any]]) -> Tracks:
        """Of (frame, point, pixel) of every observation."""
        rows = list(seen)
        return cls(
            torch.tensor([frame for frame, _, _ in rows], dtype=torch.int64),
            torch.tensor([point for _, point, _ in rows], dtype=torch.int64),
            torch.from_numpy(np.array([pixel for _, _, pixel in rows], np.float64).reshape(-1, 2)),
        )


@dataclass(frozen=True)
class Capture:
    """Everything a format holds."""

    format: str
    folder: Path  # of the data set; masks and split lists are looked for here
    image_folder: Path
    frames: tuple[Frame, ...]
    cloud: Cloud | None
    split: Mapping[str, tuple[str, ...]] | None = None  # "train", "test" -> names, where the format states them
    mask: str = "auto"  # what data.mask=auto means for this format
    width: int | None = None  # what wider images are reduced to if data.width is null; None = as stored
    tracks: Callable[[], Tracks] | None = None
    notes: tuple[str, ...] = ()


SPLITS = ("auto", "files", "every", "all")


@dataclass(frozen=True)
class DataSettings:
    """What the user decides. The defaults suit a folder about which nothing else is known."""

    dataset: str | None = None  # a name of DATASETS: its mask, size and where to get it
    width: int | None = None  # panoramas are reduced to this width (area filter); None = as stored
    images: str | None = None  # image folder, relative to the data set's; None = found
    points: str = "auto"  # auto | random | a PLY file, relative to the data set's folder
    mask: str = "auto"  # auto | none | rows:959/1024 (keep the first 959 of 1024) | a file, or a folder of files
    split: str = "auto"  # auto | files (train.txt, test.txt) | every (k-th view) | all (train on everything)
    test_every: int = 8  # k of split=every
    cache_bytes: int = 1 << 30  # decoded images kept, all views together
    read_ahead: int = 2  # threads that decode images before they are asked for
    generator: Mapping[str, Any] = field(default_factory=dict)  # knobs of the synthetic scene

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise DataError(f"unknown data.split {self.split!r}; known: {', '.join(SPLITS)}")
        if self.test_every < 2:
            raise DataError(
                f"data.test_every is {self.test_every}; every k-th view is a test view, k must be 2 or more"
            )
        if self.width is not None and (self.width < 8 or self.width % 2):
            raise DataError(
                f"data.width is {self.width}; a panorama is twice as wide as high: give an even number >= 8"
            )
        for name in ("cache_bytes", "read_ahead"):
            if getattr(self, name) < 0:
                raise DataError(f"data.{name} is {getattr(self, name)}; it must be 0, which switches it off, or more")


@dataclass(frozen=True)
class DataOptions(DataSettings):
    """How to turn files into a scene."""

    device: str = "cpu"  # where decoded images are kept, as uint8
