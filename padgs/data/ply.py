"""PLY files, ASCII or binary, through plyfile: what any of them must be, and point clouds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from padgs.data.capture import Cloud, color_bytes
from padgs.data.errors import DataError
from padgs.replacing import replacing

_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


def read_ply(path: Path) -> Cloud:
    """Read the vertices of a PLY file with x, y, z and, where present, red, green, blue (0..255, or floats in 0..1).

    Raises:
        DataError: not there, not a PLY file, cut short, or without x, y, z.
    """
    vertex, names = read_vertices(path)
    if not {"x", "y", "z"} <= names:
        raise DataError(f"{path} has the properties {', '.join(sorted(names))}; a point cloud needs x, y and z")
    points = np.stack([np.asarray(vertex[axis], dtype=np.float64) for axis in "xyz"], axis=1)
    channels = next((group for group in _COLORS if set(group) <= names), None)
    colors = None
    if channels is not None:
        values = np.stack([np.asarray(vertex[channel]) for channel in channels], axis=1)
        if values.dtype.kind == "f" and len(values) and values.max() <= 1:
            values = values * 255
        colors = color_bytes(torch.from_numpy(values.astype(np.float64)), str(path))
    return Cloud(torch.from_numpy(points), colors)


def read_vertices(path: Path) -> tuple[Any, set[str]]:
    """The vertices of a PLY file, a column for each property's name, and those names.

    Raises:
        DataError: not there, not a PLY file, cut short, or without vertices.
    """
    from plyfile import PlyData, PlyParseError

    try:
        vertex = PlyData.read(str(path))["vertex"]  # mapped: read row by row, 500 000 Gaussians take minutes
    except FileNotFoundError as error:
        raise DataError(f"the point cloud {path} does not exist") from error
    except KeyError as error:
        raise DataError(f"{path} has no element 'vertex'; it must be a point cloud") from error
    except (PlyParseError, OSError, ValueError, MemoryError, OverflowError, EOFError) as error:
        raise DataError(
            f"{path} is not a readable PLY file ({error or type(error).__name__}); export it again"
        ) from error
    return vertex, {prop.name for prop in vertex.properties}


def write_ply(path: Path, cloud: Cloud) -> None:
    """Write a binary PLY file with x, y, z as doubles (nothing is lost) and red, green, blue if there are colours."""
    from plyfile import PlyData, PlyElement

    columns, fields = [*cloud.points.T.numpy()], [(axis, "f8") for axis in "xyz"]
    if cloud.colors is not None:
        columns += [*cloud.colors.T.numpy()]
        fields += [(channel, "u1") for channel in _COLORS[0]]
    vertex = np.rec.fromarrays(columns, dtype=fields)
    with replacing(path) as draft:
        PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(draft))
