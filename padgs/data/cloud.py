"""The point cloud a scene starts from: checked, coloured, or made up where a format has none."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from padgs.data.capture import Capture, Cloud
from padgs.data.errors import DataError
from padgs.data.ply import read_ply
from padgs.data.trajectory import centers

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
