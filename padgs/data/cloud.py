"""Point clouds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from padgs.data.camera_paths import centers
from padgs.data.capture import Capture, Cloud, DataError, color_bytes
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


RANDOM_POINTS = 100_000
RANDOM_RADII = (0.5, 50.0)  # nearest and farthest made-up point, in multiples of the cameras' spread
GREY = 128


def starting_cloud(capture: Capture, source: str) -> tuple[Tensor, Tensor, tuple[str, ...]]:
    """Points [P, 3] float64, colours [P, 3] uint8 and notes.

    Args:
        capture: what the format holds.
        source: `data.points`: auto (the format's own, else random), random, or a PLY file.

    Raises:
        DataError: no point, or one that is not finite.
    """
    notes: tuple[str, ...] = ()
    cloud, where = capture.cloud, f"the {capture.format} model in {capture.folder}"
    if source not in ("auto", "random"):
        path = capture.folder / source
        cloud, where = read_ply(path), str(path)
    elif source == "random" or cloud is None:
        cloud = random_cloud(torch.stack([frame.cam_from_world for frame in capture.frames]))
        why = (
            "data.points=random"
            if source == "random"
            else f"{capture.format} holds none; set data.points to a PLY file"
        )
        notes = (f"points: {RANDOM_POINTS} random ones around the cameras ({why})",)
    points, colors = cloud.points, cloud.colors
    if not len(points):
        raise DataError(
            f"{where} holds no points; training starts from a point cloud: set data.points to a PLY file, or to random"
        )
    bad = (~points.float().isfinite().all(1)).sum().item()
    if bad:
        raise DataError(f"{bad} of {len(points)} points of {where} are not finite; remove them from the cloud")
    if colors is None:
        colors = torch.full((len(points), 3), GREY, dtype=torch.uint8)
        notes = (*notes, "points: they have no colours; grey is taken")
    return points.double(), colors, notes


def random_cloud(cam_from_world: Tensor, count: int = RANDOM_POINTS) -> Cloud:
    """Grey points in all directions around the cameras [F, 4, 4], their distances spread evenly on a log scale.

    Always the same for the same cameras, and it scales with them.
    """
    places = centers(cam_from_world)
    middle = places.mean(0)
    spread = (places - middle).norm(dim=1).max().clamp(min=1e-9)
    source = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=source, dtype=torch.float64), dim=1)
    near, far = RANDOM_RADII
    radius = near * (far / near) ** torch.rand(count, 1, generator=source, dtype=torch.float64)
    return Cloud(middle + spread * radius * direction, None)


def existing_ply(folder: Path, names: tuple[str, ...]) -> Cloud | None:
    """The first of the named PLY files that is in a folder."""
    return next((read_ply(folder / name) for name in names if (folder / name).is_file()), None)
