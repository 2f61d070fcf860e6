"""EgoNeRF's grids and samples: two charts of the sphere, exponential nodes, planes times lines; samples along rays.

Yin and yang are two charts without poles, 90 degrees of latitude by 270 degrees of longitude each. Yin holds the
directions with polar angle acos(z / r) in [pi/4, 3 pi/4] and azimuth atan2(y, x) in [-3 pi/4, 3 pi/4]; yang holds all
others, by the same angles after the swap (x, y, z) -> (-x, z, y), its own inverse.

A function on both charts' (radius, polar, azimuth) boxes is a sum of planes times lines (VM decomposition of TensoRF).
Every tensor has one slice per chart side by side along its first grid axis, so one bilinear look-up serves both charts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

POLAR_SPAN = math.pi / 2  # of a chart, around the equator
AZIMUTH_SPAN = 3 * math.pi / 2
YIN, YANG = 0, 1
CHARTS = 2
# Each mode is a plane over two axes and a line over the third; the first axis of a plane carries the charts.
MODES = ((("polar", "radius"), "azimuth"), (("azimuth", "radius"), "polar"), (("polar", "azimuth"), "radius"))
MIN_WEIGHT = 1e-5  # added to every weight of a coarse sample, so that empty rays are still sampled everywhere
THREADS = 4  # grid_sample is parallel over its batch only, so channels are split into so many batch entries


def locate(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the chart (YIN or YANG) of points [..., 3], and where polar angle and azimuth lie in its span, in [0, 1].

    >>> chart, polar, azimuth = locate(torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    >>> chart.tolist(), polar.tolist(), azimuth.tolist()
    ([0, 1], [0.5, 0.5], [0.5, 0.8333333730697632])
    """
    polar, azimuth = _angles(points)
    inside = ((polar - math.pi / 2).abs() <= POLAR_SPAN / 2) & (azimuth.abs() <= AZIMUTH_SPAN / 2)
    other_polar, other_azimuth = _angles(swapped(points))
    polar = torch.where(inside, polar, other_polar)
    azimuth = torch.where(inside, azimuth, other_azimuth)
    place = ((polar - math.pi / 2) / POLAR_SPAN + 0.5).clamp(0, 1), (azimuth / AZIMUTH_SPAN + 0.5).clamp(0, 1)
    return torch.where(inside, YIN, YANG), *place


def swapped(points: Tensor) -> Tensor:
    """Return (-x, z, y) for points (x, y, z): from yin's axes to yang's and back."""
    x, y, z = points.unbind(-1)
    return torch.stack((-x, z, y), dim=-1)


def _angles(points: Tensor) -> tuple[Tensor, Tensor]:
    x, y, z = points.unbind(-1)
    return torch.atan2(torch.sqrt(x * x + y * y), z), torch.atan2(y, x)


def exponential_nodes(first: float, last: float, count: int) -> Tensor:
    """Return distances 0, first, first q, first q^2, ... `last`, no interval shorter than `first`, [count] float64.

    Intervals of the geometric series shorter than `first` become `first`, and all nodes behind them shift outwards (the
    published interval threshold); so the nodes end at or behind `last`.

    >>> exponential_nodes(1.0, 4.0, 4).tolist()
    [0.0, 1.0, 2.0, 4.0]
    """
    steps = torch.arange(count - 1, dtype=torch.float64)
    nodes = first * (last / first) ** (steps / (count - 2))
    intervals = torch.cat((nodes[:1], nodes.diff())).clamp(min=first)
    return torch.cat((torch.zeros(1, dtype=torch.float64), intervals.cumsum(0)))


def node_fraction(radius: Tensor, nodes: Tensor) -> Tensor:
    """Return the piecewise linear position of radii [...] among increasing nodes [N], from 0 to 1."""
    last = len(nodes) - 1
    upper = torch.searchsorted(nodes, radius.contiguous(), right=True).clamp(1, last)
    below, above = nodes[upper - 1], nodes[upper]
    return ((upper - 1 + (radius - below) / (above - below)) / last).clamp(0, 1)


class GridPosition(NamedTuple):
    """Positions in the grids: chart, and position along each axis in [0, 1]."""

    chart: Tensor  # [N] int64
    radius: Tensor  # [N]
    polar: Tensor  # [N]
    azimuth: Tensor  # [N]


class Factors(NamedTuple):
    """Planes and lines of the three modes."""

    planes: tuple[Tensor, ...]  # 3 x [C, 2, first axis, second axis]
    lines: tuple[Tensor, ...]  # 3 x [C, 2, axis]


class PlaneLines(nn.Module):
    """Learnable factors with C components per mode, initialised from a normal distribution."""

    def __init__(self, components: int, shape: dict[str, int]) -> None:
        """Build factors; `shape` is the number of nodes along radius, polar and azimuth in each chart."""
        super().__init__()

        def noise(*axes: str) -> nn.Parameter:
            size = (components, CHARTS, *(shape[axis] for axis in axes))
            return nn.Parameter(0.1 * torch.randn(size))

        self.planes = nn.ParameterList([noise(*axes) for axes, _ in MODES])
        self.lines = nn.ParameterList([noise(axis) for _, axis in MODES])

    def factors(self) -> Factors:
        """Return the factors at full resolution."""
        return Factors(tuple(self.planes), tuple(self.lines))

    def coarse(self) -> Factors:
        """Return the factors at half the resolution, averaged over pairs of nodes."""
        planes = tuple(functional.avg_pool2d(plane, 2) for plane in self.planes)
        lines = tuple(functional.avg_pool1d(line, 2) for line in self.lines)
        return Factors(planes, lines)

    def variation(self) -> Tensor:
        """Return twice the mean squared difference of neighbours, summed over axes, planes and charts; a scalar."""
        total = self.planes[0].new_zeros(())
        for plane in self.planes:
            # The published sum runs over charts, each of which is a mean: a mean over both counts twice.
            total = total + 2 * CHARTS * (plane.diff(dim=-1).square().mean() + plane.diff(dim=-2).square().mean())
        return total


def grid_position(points: Tensor, nodes: Tensor) -> GridPosition:
    """Return positions of points [N, 3] relative to the centre, on grids with radial nodes at distances [R]."""
    chart, polar, azimuth = locate(points)
    return GridPosition(chart, node_fraction(points.norm(dim=-1), nodes), polar, azimuth)


def products(factors: Factors, at: GridPosition) -> list[Tensor]:
    """Return plane x line at N positions, [C, N] for each mode."""
    return [
        _look_up(plane, at.chart, getattr(at, axes[0]), getattr(at, axes[1]))
        * _look_up(line[..., None], at.chart, getattr(at, along), None)
        for (axes, along), plane, line in zip(MODES, factors.planes, factors.lines, strict=True)
    ]


def density_feature(factors: Factors, at: GridPosition) -> Tensor:
    """Return the sum over modes of ReLU(sum over components of plane x line), [N]."""
    return torch.stack([functional.relu(product.sum(0)) for product in products(factors, at)]).sum(0)


def _look_up(image: Tensor, chart: Tensor, first: Tensor, second: Tensor | None) -> Tensor:
    """Interpolate an image [C, 2, H, W] with nodes at its corners at N places, [C, N]; `first` runs along H."""
    components, charts, height, width = image.shape
    row = (chart * height + first * (height - 1)) * (2 / (charts * height - 1)) - 1
    column = torch.zeros_like(row) if second is None else 2 * second - 1
    places = torch.stack((column, row), dim=-1)[None, :, None]  # [1, N, 1, 2]
    parts = math.gcd(components, THREADS)
    values = functional.grid_sample(
        image.reshape(parts, components // parts, charts * height, width),
        places.expand(parts, -1, -1, -1),
        align_corners=True,
        padding_mode="border",
    )
    return values.reshape(components, -1)


def interval_lengths(distances: Tensor) -> Tensor:
    """Return the length [..., S] of the interval behind each distance [..., S]; the last repeats the one before.

    >>> interval_lengths(torch.tensor([1.0, 2.0, 5.0])).tolist()
    [1.0, 3.0, 3.0]
    """
    lengths = distances.diff(dim=-1)
    return torch.cat((lengths, lengths[..., -1:]), dim=-1)


def refined(distances: Tensor, weights: Tensor, shares: Tensor) -> Tensor:
    """Return distances of fine samples [B, F]: quantiles at shares [B, F] of the inner of coarse weights [B, S]."""
    midpoints = (distances[:, 1:] + distances[:, :-1]) / 2
    return inverse_cdf(midpoints, weights[:, 1:-1] + MIN_WEIGHT, shares)


def inverse_cdf(edges: Tensor, weights: Tensor, shares: Tensor) -> Tensor:
    """Return quantiles [B, F] at shares [B, F] of a density with masses [B, M] > 0 between edges [B, M + 1].

    >>> inverse_cdf(torch.tensor([[0.0, 1.0, 2.0]]), torch.tensor([[1.0, 3.0]]), torch.tensor([[0.25, 0.625]])).tolist()
    [[1.0, 1.5]]
    """
    cumulative = torch.cat((torch.zeros_like(weights[:, :1]), weights.cumsum(-1)), dim=-1)
    mass = (shares * cumulative[:, -1:]).contiguous()
    piece = torch.searchsorted(cumulative, mass, right=True).clamp(1, weights.shape[1]) - 1
    below, weight = cumulative.gather(1, piece), weights.gather(1, piece)
    low, high = edges.gather(1, piece), edges.gather(1, piece + 1)
    return low + (high - low) * ((mass - below) / weight).clamp(0, 1)


def visible_shares(optical_depths: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weight [..., S] of each interval of a ray, and the transmittance [...] behind all; together 1.

    weight_k = exp(-sum of the depths in front) (1 - exp(-depth_k)), exact for intervals of constant density; depths
    [..., S] are density times length, from front to back.

    >>> weights, residual = visible_shares(torch.tensor([0.6931472, 0.6931472]))
    >>> weights.tolist(), residual.item()
    ([0.5, 0.25], 0.25)
    """
    behind = torch.exp(-optical_depths.cumsum(-1))
    front = torch.cat((torch.ones_like(behind[..., :1]), behind[..., :-1]), dim=-1)
    return front * -torch.expm1(-optical_depths), behind[..., -1]
