"""Cameras: the direction of each pixel. Camera frame x right, y down, z forward; pixel centres at half integers.

Panorama and pinhole are formulas; any other camera (fisheye, cylinder, calibrated lens) is a table of rays. Panoramas
and pinholes are equal if their numbers are.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from padgs.geometry.panorama import Device, rays


@dataclass(frozen=True)
class Panorama:
    """The full sphere as an equirectangular image (paper Eq. 6-7; `padgs.geometry.panorama`)."""

    width: int
    height: int
    kind: ClassVar[str] = "panorama"

    def rays(self, *, dtype: torch.dtype = torch.float32, device: Device = "cpu") -> Tensor:
        """Return unit directions [H, W, 3] through the pixel centres."""
        return rays(self.width, self.height, dtype=dtype, device=device)

    @property
    def focal(self) -> float:
        """Return the pixels per radian on the horizon, W / 2 pi."""
        return self.width / (2 * torch.pi)


@dataclass(frozen=True)
class Pinhole:
    """A perspective camera: u = fx x / z + cx, v = fy y / z + cy."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    kind: ClassVar[str] = "pinhole"

    def rays(self, *, dtype: torch.dtype = torch.float32, device: Device = "cpu") -> Tensor:
        """Return unit directions [H, W, 3] through the pixel centres."""
        x = (torch.arange(self.width, dtype=dtype, device=device) + 0.5 - self.cx) / self.fx
        y = (torch.arange(self.height, dtype=dtype, device=device) + 0.5 - self.cy) / self.fy
        grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
        return torch.nn.functional.normalize(torch.stack((grid_x, grid_y, torch.ones_like(grid_x)), dim=-1), dim=-1)

    @property
    def focal(self) -> float:
        """Return the pixels per radian at the principal point, the geometric mean of both focal lengths."""
        return (self.fx * self.fy) ** 0.5


def perspective(width: int, height: int, fov: float) -> Pinhole:
    """Return a pinhole with a horizontal field of view of `fov` degrees, square pixels and a central axis."""
    if width < 1 or height < 1 or not 0 < fov < 180:
        raise ValueError(
            f"an image of {width}x{height} pixels and {fov:g} degrees is impossible; sizes must be at least 1, and the "
            "field of view between 0 and 180 degrees"
        )
    focal = width / 2 / math.tan(math.radians(fov) / 2)
    return Pinhole(width, height, focal, focal, width / 2, height / 2)


@dataclass(frozen=True, eq=False)
class RayTable:
    """Any central camera: one unit direction per pixel. Gradients flow to the table if the projection allows it."""

    table: Tensor  # [H, W, 3] unit, camera frame
    focal: float  # pixels per radian, for low-pass filters given in pixels
    kind: str = "rays"  # name of the camera model

    @property
    def width(self) -> int:
        """Return the number of columns."""
        return self.table.shape[1]

    @property
    def height(self) -> int:
        """Return the number of rows."""
        return self.table.shape[0]

    def rays(self, *, dtype: torch.dtype = torch.float32, device: Device = "cpu") -> Tensor:
        """Return the table [H, W, 3]."""
        return self.table.to(device=device, dtype=dtype)


Camera = Panorama | Pinhole | RayTable


def pixel_solid_angles(camera: Camera) -> Tensor:
    """Return the solid angle [H, W] float64 of each pixel in steradians, by differences of rays; at least 3x3 pixels.

    >>> round(pixel_solid_angles(perspective(100, 100, 90.0)).sum().item() / (4 * math.pi), 3)  # a face of a cube
    0.167
    """
    table = camera.rays(dtype=torch.float64)
    down, across = (torch.gradient(table, dim=dim, edge_order=2)[0] for dim in (0, 1))
    return torch.linalg.cross(across, down).norm(dim=-1)


def sphere_share(camera: Camera) -> float:
    """Return the share of all directions that a camera sees."""
    return min(1.0, pixel_solid_angles(camera).sum().item() / (4 * math.pi))
