"""Point clouds: PLY files through plyfile, and the cloud from which training starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from padgs.data.camera_paths import centers
from padgs.data.capture import Capture, Cloud, DataError, color_bytes
from padgs.files import atomic_path

_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


def read_ply(path: Path) -> Cloud:
    """Read a point cloud from a PLY file: x, y, z and optional red, green, blue (0..255, or floats in 0..1).

    Raises:
        DataError: missing file, no PLY file, truncated, or without x, y, z.
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
    """Return the vertices of a PLY file, one column per property, and the property names.

    Raises:
        DataError: missing file, no PLY file, truncated, or without vertices.
    """
    from plyfile import PlyData, PlyParseError

    try:
        vertex = PlyData.read(str(path))["vertex"]  # memory-mapped; reading 500 000 Gaussians row by row takes minutes
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
    """Write a binary PLY file: x, y, z as doubles, which is lossless, and red, green, blue if there are colours."""
    from plyfile import PlyData, PlyElement

    columns, fields = [*cloud.points.T.numpy()], [(axis, "f8") for axis in "xyz"]
    if cloud.colors is not None:
        columns += [*cloud.colors.T.numpy()]
        fields += [(channel, "u1") for channel in _COLORS[0]]
    vertex = np.rec.fromarrays(columns, dtype=fields)
    with atomic_path(path) as draft:
        PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(draft))


RANDOM_POINTS = 100_000
RANDOM_RADII = (0.5, 50.0)  # nearest and farthest random point, in multiples of the camera radius
GREY = 128


def initial_cloud(capture: Capture, source: str) -> tuple[Tensor, Tensor, tuple[str, ...]]:
    """Return the initial points [P, 3] float64, their colours [P, 3] uint8, and notes.

    Args:
        capture: a data set.
        source: `data.points`: auto (the format's own, else random), random, or a PLY file.

    Raises:
        DataError: there is no point, or one is not finite.
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
        notes = (f"points: {RANDOM_POINTS} random points around the cameras ({why})",)
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
        notes = (*notes, "points: the cloud has no colours; grey is used")
    return points.double(), colors, notes


def random_cloud(cam_from_world: Tensor, count: int = RANDOM_POINTS) -> Cloud:
    """Draw random points around cameras [F, 4, 4], uniform in direction and in the logarithm of the distance.

    Deterministic, and equivariant to the scale of the cameras.
    """
    positions = centers(cam_from_world)
    middle = positions.mean(0)
    spread = (positions - middle).norm(dim=1).max().clamp(min=1e-9)
    source = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=source, dtype=torch.float64), dim=1)
    near, far = RANDOM_RADII
    radius = near * (far / near) ** torch.rand(count, 1, generator=source, dtype=torch.float64)
    return Cloud(middle + spread * radius * direction, None)


def first_ply(folder: Path, names: tuple[str, ...]) -> Cloud | None:
    """Read the first of the named PLY files that exists in a folder; None if there is none."""
    return next((read_ply(folder / name) for name in names if (folder / name).is_file()), None)
