"""What is decided about a data source: by the user in the `data` group of the configuration, and by the run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from padgs.data.errors import DataError

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
