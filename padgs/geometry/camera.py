"""Cameras: which direction each pixel looks. Camera frame x right, y down, z forward; pixel centres at half integers.

A panorama is a formula, a pinhole is a formula, and everything else (fisheye, cylinder, calibrated lens) is a table of
rays. Cameras are values: two of the same numbers are the same camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.geometry.panorama import rays


@dataclass(frozen=True)
class Panorama:
    """The full sphere as an equirectangular image (paper Eq. 6-7; `padgs.geometry.panorama`)."""

    width: int
    height: int

    def rays(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
        """Unit directions [H, W, 3] through the pixel centres."""
        return rays(self.width, self.height, dtype=dtype, device=device)

    @property
    def focal(self) -> float:
        """Pixels per radian on the horizon, W / 2 pi."""
        return self.width / (2 * torch.pi)


@dataclass(frozen=True)
class Pinhole:
    """An ordinary perspective camera: u = fx x / z + cx, v = fy y / z + cy."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def rays(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
        """Unit directions [H, W, 3] through the pixel centres."""
        x = (torch.arange(self.width, dtype=dtype, device=device) + 0.5 - self.cx) / self.fx
        y = (torch.arange(self.height, dtype=dtype, device=device) + 0.5 - self.cy) / self.fy
        grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
        return torch.nn.functional.normalize(torch.stack((grid_x, grid_y, torch.ones_like(grid_x)), dim=-1), dim=-1)

    @property
    def focal(self) -> float:
        """Pixels per radian at the principal point, the geometric mean of both focal lengths."""
        return (self.fx * self.fy) ** 0.5


def perspective(width: int, height: int, fov: float) -> Pinhole:
    """A pinhole that shows `fov` degrees across the width, with square pixels and its axis in the middle.

    Raises:
        ValueError: a side without a pixel, or a field of view that is not between 0 and 180 degrees.
    """
    if width < 1 or height < 1 or not 0 < fov < 180:
        raise ValueError(f"no perspective picture has {width}x{height} pixels across {fov:g} degrees (0 to 180)")
    focal = width / 2 / math.tan(math.radians(fov) / 2)
    return Pinhole(width, height, focal, focal, width / 2, height / 2)


@dataclass(frozen=True, eq=False)
class RayTable:
    """Any central camera: one unit direction per pixel. Gradients flow to the table where the projection allows it."""

    table: Tensor  # [H, W, 3] unit, camera frame
    focal: float  # pixels per radian, which sets the size of low-pass filters given in pixels

    @property
    def width(self) -> int:
        """Pixels in a row."""
        return self.table.shape[1]

    @property
    def height(self) -> int:
        """Pixels in a column."""
        return self.table.shape[0]

    def rays(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
        """The table [H, W, 3]."""
        return self.table.to(device=device, dtype=dtype)


Camera = Panorama | Pinhole | RayTable
