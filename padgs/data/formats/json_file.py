"""JSON files of other programs: values that know where they stand, so that whatever is wrong names its place."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from padgs.data.errors import DataError
from padgs.data.images import read_bytes
from padgs.data.splits import check_inside


@dataclass(frozen=True)
class Json:
    """A value of a JSON file."""

    value: Any
    where: str  # in words: "transform_matrix of pano_00.png in FILE"

    def __getitem__(self, key: str) -> Json:
        if not isinstance(self.value, Mapping):
            raise DataError(f"{self.where} must be an object with the field {key!r}, not {type(self.value).__name__}")
        if key not in self.value:
            has = ", ".join(map(str, self.value)) or "none"
            raise DataError(f"{self.where} lacks the field {key!r}; it has {has}")
        return Json(self.value[key], f"{key} of {self.where}")

    def get(self, key: str, default: Any = None) -> Any:
        """The bare value of a field that may be absent."""
        return self.value.get(key, default)

    def entries(self) -> list[Json]:
        """What a list holds.

        Raises:
            DataError: it is no list.
        """
        if not isinstance(self.value, list):
            raise DataError(f"{self.where} must be a list, not {type(self.value).__name__}")
        return [Json(entry, f"entry {i} of {self.where}") for i, entry in enumerate(self.value)]

    def name(self) -> str:
        """The path of a file inside the folder it is relative to."""
        return check_inside(str(self.value), self.where)

    def numbers(self, *shape: int) -> Tensor:
        """A nested list of numbers as a float64 tensor; of the given shape, if one is given.

        Raises:
            DataError: something else than numbers, or of another shape.
        """
        try:
            tensor = torch.tensor(self.value, dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError) as error:
            raise DataError(f"{self.where} is not an array of numbers ({error})") from error
        if shape and tensor.shape != shape:
            raise DataError(f"{self.where} has the shape {list(tensor.shape)}; it must be {list(shape)}")
        return tensor


def read_json(path: Path) -> Json:
    """The contents of a JSON file.

    Raises:
        DataError: not there, unreadable or not JSON; says in which line.
    """
    try:
        return Json(json.loads(read_bytes(path).decode("utf-8-sig")), str(path))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise DataError(f"{path} is not valid JSON ({error}); export it again") from error


def file_in(path: Path, name: str) -> Path:
    """The file that describes a data set, of which `path` is the folder or that very file."""
    return path if path.is_file() else path / name
