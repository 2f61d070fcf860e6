"""Yin and yang: two charts of the sphere without poles, 90 degrees of latitude by 270 degrees of longitude each.

Yin holds the directions with polar angle acos(z / r) in [pi/4, 3 pi/4] and azimuth atan2(y, x) in [-3 pi/4, 3 pi/4];
yang, all others, by the same angles after the swap (x, y, z) -> (-x, z, y), which is its own inverse.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

POLAR_SPAN = math.pi / 2  # of a chart, around the equator
AZIMUTH_SPAN = 3 * math.pi / 2
YIN, YANG = 0, 1


class ChartPosition(NamedTuple):
    """Where directions lie: chart and place in it."""

    chart: Tensor  # [...] int64, YIN or YANG
    polar: Tensor  # [...] in [0, 1] from the chart's polar angle pi/4 to 3 pi/4
    azimuth: Tensor  # [...] in [0, 1] from -3 pi/4 to 3 pi/4


def locate(points: Tensor) -> ChartPosition:
    """Chart and place of points [..., 3], of any length; a point at the centre belongs to some place.

    >>> chart, polar, azimuth = locate(torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    >>> chart.tolist(), polar.tolist(), azimuth.tolist()
    ([0, 1], [0.5, 0.5], [0.5, 0.8333333730697632])
    """
    polar, azimuth = _angles(points)
    inside = ((polar - math.pi / 2).abs() <= POLAR_SPAN / 2) & (azimuth.abs() <= AZIMUTH_SPAN / 2)
    other_polar, other_azimuth = _angles(swapped(points))
    polar = torch.where(inside, polar, other_polar)
    azimuth = torch.where(inside, azimuth, other_azimuth)
    return ChartPosition(
        torch.where(inside, YIN, YANG),
        ((polar - math.pi / 2) / POLAR_SPAN + 0.5).clamp(0, 1),
        (azimuth / AZIMUTH_SPAN + 0.5).clamp(0, 1),
    )


def direction(position: ChartPosition) -> Tensor:
    """Unit direction [..., 3] of a place; the inverse of `locate`."""
    polar = (position.polar - 0.5) * POLAR_SPAN + math.pi / 2
    azimuth = (position.azimuth - 0.5) * AZIMUTH_SPAN
    sin_polar = torch.sin(polar)
    unit = torch.stack((sin_polar * torch.cos(azimuth), sin_polar * torch.sin(azimuth), torch.cos(polar)), dim=-1)
    return torch.where((position.chart == YIN)[..., None], unit, swapped(unit))


def swapped(points: Tensor) -> Tensor:
    """(x, y, z) -> (-x, z, y), from yin's axes to yang's and back."""
    x, y, z = points.unbind(-1)
    return torch.stack((-x, z, y), dim=-1)


def _angles(points: Tensor) -> tuple[Tensor, Tensor]:
    x, y, z = points.unbind(-1)
    return torch.atan2(torch.sqrt(x * x + y * y), z), torch.atan2(y, x)
