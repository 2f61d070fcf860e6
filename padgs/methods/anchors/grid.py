"""Anchors: the grid vertices that a point cloud is reduced to, and that carry the Gaussians of PaD-GS.

An anchor sits on a vertex of the grid of spacing `voxel_size`, so it is named exactly by three integers, its cell.
Everything that compares anchors compares cells, never floating-point positions.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from padgs.scene import Scene
from padgs.training.initial_points import refuse_unusable, squared_spacing


def automatic_voxel_size(scene: Scene, pixels: float) -> float:
    """The voxel size in world units that spans so many pixels of the training panoramas (pi / H radians each) at the
    scene's median depth, so that neither the world's units nor the density of the point cloud matter.
    """
    return pixels * math.pi / scene.train[0].height * scene.scale


def cells_from_points(points: Tensor, size: float) -> Tensor:
    """Cells [N, 3] int64 of points [N, 3]: the nearest vertex of a grid of spacing `size`, halves to even."""
    return torch.round(points.double() / size).long()


def points_from_cells(cells: Tensor, size: float, dtype: torch.dtype = torch.float32) -> Tensor:
    """Vertices [N, 3] of a grid of spacing `size`, the inverse of `cells_from_points`."""
    return (cells.double() * size).to(dtype)


def cell_keys(cells: Tensor) -> Tensor:
    """One int64 for each row [N] of cells [N, 3], equal exactly where the rows are equal, in lexicographic order.

    A number with three digits, one per axis; or, where those are too wide for 64 bits (a far outlier in the cloud), the
    rank among the distinct rows, which takes longer to find.
    """
    if len(cells) == 0:
        return cells.new_zeros(0)
    digits = cells - cells.min(0).values
    if math.prod(side + 1 for side in digits.max(0).values.tolist()) >= 2**63:
        return torch.unique(cells, dim=0, return_inverse=True)[1]
    _, base_y, base_z = (digits.max(0).values + 1).unbind(-1)
    return (digits[:, 0] * base_y + digits[:, 1]) * base_z + digits[:, 2]


def unique_cells(cells: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct rows [U, 3] of cells [N, 3] in lexicographic order, and the row of each input in them, [N]."""
    keys, inverse = torch.unique(cell_keys(cells), return_inverse=True)
    first = torch.full_like(keys, len(cells)).scatter_reduce(
        0, inverse, torch.arange(len(cells), device=cells.device), "amin"
    )
    return cells[first], inverse


def occupied(cells: Tensor, by: Tensor) -> Tensor:
    """Which of the cells [U, 3] occur among the cells `by` [N, 3], [U] bool; sorts, O((U + N) log(U + N))."""
    keys = cell_keys(torch.cat((cells, by)))
    return torch.isin(keys[: len(cells)], keys[len(cells) :])


def anchors_from_points(points: Tensor, voxel_size: float) -> Tensor:
    """Anchor positions [A, 3] float32: the distinct grid vertices nearest to the points [P, 3], both in world units.

    Raises:
        ValueError: no points, points that are not finite, or a voxel size that is not a positive length.
    """
    if not (voxel_size > 0 and math.isfinite(voxel_size)):
        raise ValueError(f"voxel_size is {voxel_size}; it must be a length > 0 in world units, or auto")
    refuse_unusable(points, "anchors")
    cells, _ = unique_cells(cells_from_points(points, voxel_size))
    return points_from_cells(cells, voxel_size)


def initial_log_scales(positions: Tensor, voxel_size: float) -> Tensor:
    """Initial log-scales [A, 6] of anchors [A, 3]: log of the root mean square distance to the three nearest others.

    No anchor has another within a voxel, so no floor is needed; a lone anchor gets the size of a voxel.
    """
    squared = squared_spacing(positions)
    if squared is None:
        return positions.new_full((len(positions), 6), math.log(voxel_size))
    return (0.5 * torch.log(squared)).to(positions)[:, None].repeat(1, 6)
