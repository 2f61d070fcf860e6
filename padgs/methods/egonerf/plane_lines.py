"""A function on both charts' (radius, polar, azimuth) boxes as a sum of planes times lines (the VM form of TensoRF).

Every tensor has one slice per chart side by side along its first grid axis, so one bilinear look-up serves points of
both charts at once.
"""

from __future__ import annotations

from math import gcd
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from padgs.methods.egonerf.charts import locate
from padgs.methods.egonerf.radii import node_fraction

CHARTS = 2
# Each mode is a plane over two axes and a line over the third; the first axis of a plane carries the charts.
MODES = ((("polar", "radius"), "azimuth"), (("azimuth", "radius"), "polar"), (("polar", "azimuth"), "radius"))
THREADS = 4  # grid_sample works in parallel over its batch only; channels are dealt out to so many entries of it


class GridPosition(NamedTuple):
    """Places in the grids: the chart, and the share of the way along each axis in [0, 1]."""

    chart: Tensor  # [N] int64
    radius: Tensor  # [N]
    polar: Tensor  # [N]
    azimuth: Tensor  # [N]

    def where(self, keep: Tensor) -> GridPosition:
        """Those places that an index or mask selects."""
        return GridPosition(*(values[keep] for values in self))


class Factors(NamedTuple):
    """Planes and lines of the three modes."""

    planes: tuple[Tensor, ...]  # 3 x [C, 2, first axis, second axis]
    lines: tuple[Tensor, ...]  # 3 x [C, 2, axis]


class PlaneLines(nn.Module):
    """Learnable factors with C components for each mode, normally distributed at first."""

    def __init__(self, components: int, shape: dict[str, int], scale: float = 0.1) -> None:
        """`shape` is the number of nodes along radius, polar and azimuth, in each chart."""
        super().__init__()

        def noise(*axes: str) -> nn.Parameter:
            size = (components, CHARTS, *(shape[axis] for axis in axes))
            return nn.Parameter(scale * torch.randn(size))

        self.planes = nn.ParameterList([noise(*axes) for axes, _ in MODES])
        self.lines = nn.ParameterList([noise(axis) for _, axis in MODES])

    def factors(self) -> Factors:
        """The factors as they are."""
        return Factors(tuple(self.planes), tuple(self.lines))

    def coarse(self) -> Factors:
        """The factors at half the resolution, each chart averaged over pairs of nodes."""
        planes = tuple(functional.avg_pool2d(plane, 2) for plane in self.planes)
        lines = tuple(functional.avg_pool1d(line, 2) for line in self.lines)
        return Factors(planes, lines)

    def variation(self) -> Tensor:
        """Twice the mean squared difference of neighbours along each axis, summed over planes and charts; a scalar."""
        total = self.planes[0].new_zeros(())
        for plane in self.planes:
            # The published sum runs over charts, each of which is a mean: a mean over both counts twice.
            total = total + 2 * CHARTS * (plane.diff(dim=-1).square().mean() + plane.diff(dim=-2).square().mean())
        return total


def grid_position(points: Tensor, nodes: Tensor) -> GridPosition:
    """Places of points [N, 3] relative to the centre, on grids whose radial nodes [R] lie at these distances."""
    chart, polar, azimuth = locate(points)
    return GridPosition(chart, node_fraction(points.norm(dim=-1), nodes), polar, azimuth)


def products(factors: Factors, at: GridPosition) -> list[Tensor]:
    """Plane x line at N places, [C, N] for each mode."""
    found = []
    for (axes, along), plane, line in zip(MODES, factors.planes, factors.lines, strict=True):
        on_plane = _look_up(plane, at.chart, getattr(at, axes[0]), getattr(at, axes[1]))
        found.append(on_plane * _look_up(line[..., None], at.chart, getattr(at, along), None))
    return found


def density_feature(factors: Factors, at: GridPosition) -> Tensor:
    """Sum over modes of ReLU(sum over components of plane x line), [N]."""
    return torch.stack([functional.relu(product.sum(0)) for product in products(factors, at)]).sum(0)


def _look_up(image: Tensor, chart: Tensor, first: Tensor, second: Tensor | None) -> Tensor:
    """Bilinear values [C, N] of an image [C, 2, H, W] with nodes at its corners; `first` runs along H of a chart."""
    components, charts, height, width = image.shape
    row = (chart * height + first * (height - 1)) * (2 / (charts * height - 1)) - 1
    column = torch.zeros_like(row) if second is None else 2 * second - 1
    places = torch.stack((column, row), dim=-1)[None, :, None]  # [1, N, 1, 2]
    parts = gcd(components, THREADS)
    values = functional.grid_sample(
        image.reshape(parts, components // parts, charts * height, width),
        places.expand(parts, -1, -1, -1),
        align_corners=True,
        padding_mode="border",
    )
    return values.reshape(components, -1)
