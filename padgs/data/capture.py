"""What a file format says, before any pixel is read: frames with poses, points, split lists.

Every file format has one reader, `read(path, options) -> Capture`; `padgs.data.assemble` makes the scene of it, and
`padgs.data.formats.convert` writes it in another format.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from padgs.data.errors import DataError


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
