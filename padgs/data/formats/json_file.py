"""JSON files of other programs: values that know where they stand and are asked for by type, so that whatever is wrong
names its place. Readers never touch `value` itself.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from padgs.data.capture import DataError, listed
from padgs.data.images import read_bytes
from padgs.data.splits import check_inside

LARGEST = 2**53  # up to which floats tell whole numbers apart


@dataclass(frozen=True)
class Json:
    """A value of a JSON file."""

    value: Any
    where: str  # in words: "transform_matrix of pano_00.png in FILE"

    def __getitem__(self, key: str) -> Json:
        fields = self._of(Mapping, f"an object with the field {key!r}")
        if key not in fields:
            has = listed(fields) or "none"
            raise DataError(f"{self.where} lacks the field {key!r}; it has {has}")
        return Json(fields[key], f"{key} of {self.where}")

    def get(self, key: str) -> Json | None:
        """A field that may be absent, or null, which is the same."""
        return self[key] if self._of(Mapping, "an object").get(key) is not None else None

    def items(self) -> dict[str, Json]:
        """What an object holds."""
        return {key: Json(value, f"{key} of {self.where}") for key, value in self._of(Mapping, "an object").items()}

    def entries(self) -> list[Json]:
        """What a list holds."""
        return [Json(entry, f"entry {i} of {self.where}") for i, entry in enumerate(self._of(list, "a list"))]

    def text(self) -> str:
        """A text."""
        return self._of(str, "a text")

    def whole(self) -> int:
        """A whole number, such as a key or a number of pixels."""
        value = self._of((int, float), "a whole number")
        if isinstance(value, bool) or value != value or abs(value) > LARGEST or value != int(value):
            raise DataError(f"{self.where} is {value!r}; it must be a whole number up to {LARGEST}")
        return int(value)

    def name(self) -> str:
        """The path of a file inside the folder it is relative to."""
        return check_inside(self.text(), self.where)

    def numbers(self, *shape: int) -> Tensor:
        """A nested list of numbers as a float64 tensor; of the given shape, if one is given.

        Raises:
            DataError: something else than numbers, or of another shape.
        """
        try:
            tensor = torch.tensor(self.value, dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise DataError(f"{self.where} is not an array of numbers ({error})") from error
        if shape and tensor.shape != shape:
            raise DataError(f"{self.where} has the shape {list(tensor.shape)}; it must be {list(shape)}")
        return tensor

    def _of(self, kind: type | tuple[type, ...], words: str) -> Any:
        """The value, which is of this type, or refused."""
        if not isinstance(self.value, kind):
            raise DataError(f"{self.where} must be {words}, not {type(self.value).__name__}")
        return self.value


def read_json(path: Path) -> Json:
    """The contents of a JSON file.

    Raises:
        DataError: not there, unreadable or not JSON; says in which line.
    """
    try:
        return Json(json.loads(read_bytes(path).decode("utf-8-sig")), str(path))
    except (ValueError, RecursionError) as error:  # not UTF-8, not JSON, a number of thousands of digits, too deep
        raise DataError(f"{path} is not valid JSON ({error}); export it again") from error


def file_in(path: Path, name: str) -> Path:
    """The file that describes a data set, of which `path` is the folder or that very file."""
    return path if path.is_file() else path / name
