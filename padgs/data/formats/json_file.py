"""JSON files of other programs: values that know their position, so that typed access reports it in errors.

Readers use the typed accessors, not `value`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from torch import Tensor

from padgs.data.capture import DataError, by_id, first_of, listed
from padgs.data.images import read_bytes
from padgs.data.splits import check_name, is_inside, spellings
from padgs.files import folded

LARGEST = 2**53  # largest range of exact integers in floats


@dataclass(frozen=True)
class Json:
    """A value in a JSON file."""

    value: Any
    where: str  # position in words: "transform_matrix of pano_00.png in FILE"

    def __getitem__(self, key: str) -> Json:
        fields = self._of(Mapping, f"an object with the field {key!r}")
        if key not in fields:
            has = listed(fields) or "none"
            raise DataError(f"{self.where} lacks the field {key!r}; it has {has}: add it, or export the file again")
        return Json(fields[key], f"{key} of {self.where}")

    def get(self, key: str) -> Json | None:
        """Return an optional field; None if absent, null or an empty text."""
        return self[key] if self._of(Mapping, "an object").get(key) not in (None, "") else None

    def items(self) -> dict[str, Json]:
        """Return the fields of an object."""
        return {key: Json(value, f"{key} of {self.where}") for key, value in self._of(Mapping, "an object").items()}

    def entries(self) -> list[Json]:
        """Return the entries of a list."""
        return [Json(entry, f"entry {i} of {self.where}") for i, entry in enumerate(self._of(list, "a list"))]

    def text(self) -> str:
        """Return a string."""
        return self._of(str, "a text")

    def whole(self) -> int:
        """Return an integer, such as a key or a number of pixels."""
        value = self._of((int, float), "a whole number")
        if isinstance(value, bool) or value != value or abs(value) > LARGEST or value != int(value):
            raise DataError(f"{self.where} is {value!r}; it must be a whole number up to {LARGEST}")
        return int(value)

    def name(self) -> str:
        """Return the name of a file."""
        return check_name(self.text(), self.where)

    def path_in(self, folder: Path) -> Path:
        """Return the file of a name in a folder; a DataError if it points outside, and no end of it is there."""
        name = self.name()
        if is_inside(name) and (folder / name).is_file():
            return folder / name
        found = [folder / end for end in spellings(name) if is_inside(end) and (folder / end).is_file()]
        if not found and is_inside(name):  # in another case or Unicode form
            file = folder
            for part in PurePosixPath(name.replace("\\", "/")).parts:
                there = {} if (file / part).exists() or not file.is_dir() else _there(file, file.stat().st_mtime_ns)
                file = file / there.get(folded(part), part)
            found = [file] if file.is_file() else []
        if not found and not is_inside(name):
            rule = "names must be relative and stay inside the folder: put it there"
            raise DataError(f"{self.where} names {name!r}; {rule}")
        return (found or [folder / name])[0]

    def numbers(self, *shape: int) -> Tensor:
        """Return nested numbers as a float64 tensor; a DataError if they are none, or of another shape than given."""
        if not _is_numbers(self.value):
            raise DataError(f"{self.where} is not an array of numbers; write numbers, without quotes")
        try:
            tensor = torch.tensor(self.value, dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise DataError(f"{self.where} is not an array of numbers ({error})") from error
        if shape and tensor.shape != shape:
            raise DataError(f"{self.where} has the shape {list(tensor.shape)}; it must be {list(shape)}")
        return tensor

    def _of(self, kind: type | tuple[type, ...], words: str) -> Any:
        """Return the value if it has this type, else refuse it."""
        if not isinstance(self.value, kind):
            found = type(self.value).__name__ if isinstance(self.value, (Mapping, list)) else repr(self.value)
            raise DataError(f"{self.where} must be {words}, not {found:.60}; correct it, or export the file again")
        return self.value


@lru_cache(maxsize=64)
def _there(folder: Path, changed: int) -> dict[str, str]:
    """Return the names in a folder by their `folded` form; once for all names of a file, until the folder changes."""
    return {folded(path.name): path.name for path in sorted(folder.glob("*"), reverse=True)}


def _is_numbers(value: Any) -> bool:
    return all(map(_is_numbers, value)) if isinstance(value, list) else type(value) in (int, float)


def read_json(path: Path) -> Json:
    """Read a JSON file; a DataError if it cannot be read, has a field twice, or names the line that is not JSON."""

    def fields(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        return found if len(found) == len(pairs) else by_id(pairs, f"an object of {path}")

    try:
        return Json(json.loads(read_bytes(path), object_pairs_hook=fields), str(path))
    except DataError:
        raise
    except (ValueError, RecursionError) as error:  # not UTF-8, not JSON, huge numbers, deep nesting
        raise DataError(f"{path} is not valid JSON ({error}); export it again") from error


def file_in(path: Path, name: str) -> Path:
    """Return the file that describes a data set; `path` is its folder or the file itself."""
    return path if path.is_file() else first_of(path, (name,)) or path / name
