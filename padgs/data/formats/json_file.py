"""JSON files of other programs: read whole, and asked for their fields by name."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from padgs.data.errors import DataError


def read_json(path: Path) -> Any:
    """The contents of a JSON file.

    Raises:
        DataError: not there, unreadable or not JSON; says in which line.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise DataError(f"{path} does not exist") from error
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}); check its permissions") from error
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise DataError(f"{path} is not valid JSON ({error}); export it again") from error


def entry(mapping: Any, key: str, where: str) -> Any:
    """The value of a field.

    Raises:
        DataError: there is no such field; says which there are.
    """
    if not isinstance(mapping, Mapping):
        raise DataError(f"{where} must be an object with the field {key!r}, not {type(mapping).__name__}")
    if key not in mapping:
        raise DataError(f"{where} lacks the field {key!r}; it has {', '.join(map(str, mapping)) or 'none'}")
    return mapping[key]


def entries(mapping: Any, key: str, where: str) -> list[Any]:
    """The value of a field that must be a list."""
    value = entry(mapping, key, where)
    if not isinstance(value, list):
        raise DataError(f"{where}: {key!r} must be a list, not {type(value).__name__}")
    return value


def numbers(value: Any, shape: tuple[int, ...], where: str) -> Tensor:
    """A nested list of numbers as a float64 tensor of the given shape.

    Raises:
        DataError: something else than numbers, or of another shape.
    """
    try:
        tensor = torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise DataError(f"{where} is not an array of numbers ({error})") from error
    if tensor.shape != shape:
        raise DataError(f"{where} has the shape {list(tensor.shape)}; it must be {list(shape)}")
    return tensor
