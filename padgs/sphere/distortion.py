"""The distortion map and the solid-angle weight of a panorama. Paper Eq. 8-12 and 17.

An ERP pixel at latitude t covers a solid angle proportional to cos(t): the image stretches the sphere by 1 / cos(t)
(Eq. 11). The paper turns this into a distortion degree, Omega = 1 - cos^2(t) = sin^2(t) in [0, 1]: 0 on the horizon,
1 at the poles. Latitude is always that of the *camera* frame.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from padgs.sphere.panorama import row_latitudes


def distortion(points: Tensor) -> Tensor:
    """Distortion degree sin^2(latitude) of camera-frame points (Eq. 12 at the pixel that the point projects to).

    Written as y^2 / r^2: no square root, so it is smooth everywhere, on the polar axis too.

    Args:
        points: [..., 3] camera frame, not at the camera.

    Returns:
        [...] in [0, 1].

    >>> distortion(torch.tensor([[0.0, 0.0, 3.0], [0.0, -2.0, 0.0], [1.0, 1.0, 0.0]]))
    tensor([0.0000, 1.0000, 0.5000])
    """
    squares = points * points
    return squares[..., 1] / squares.sum(-1)


def distortion_map(
    width: int, height: int, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Tensor:
    """The distortion map Omega [H, W] at pixel centres (Eq. 12)."""
    sine = torch.sin(row_latitudes(height, dtype=dtype, device=device))
    return (sine * sine)[:, None].expand(height, width)


def solid_angle_weight(
    height: int, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Tensor:
    """The weight M = cos(latitude) of each image row, [H], at pixel centres (Eq. 17); positive everywhere.

    >>> solid_angle_weight(2)
    tensor([0.7071, 0.7071])
    """
    return torch.cos(row_latitudes(height, dtype=dtype, device=device))


def end_row_weight(height: int, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
    """The row weight [H] of the released code: cos(pi i / (H - 1) - pi / 2), which is 0 in the first and last row."""
    rows = torch.arange(height, dtype=dtype, device=device)
    return torch.cos(math.pi * rows / (height - 1) - math.pi / 2)


def pixel_solid_angle(
    width: int, height: int, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Tensor:
    """Exact solid angle in steradian of one pixel of each row, [H]; the whole image sums to 4 pi (Eq. 8-10).

    The integral of cos over a row is 2 sin(h / 2) cos(latitude) for row height h, so M is exactly proportional to it.

    >>> round((pixel_solid_angle(8, 4).sum() * 8 / math.pi).item(), 5)
    4.0
    """
    row_height = math.pi / height
    longitude_step = 2 * math.pi / width
    return longitude_step * 2 * math.sin(row_height / 2) * solid_angle_weight(height, dtype=dtype, device=device)
