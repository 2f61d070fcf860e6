"""Distortion degree Omega, opacity modulation, and solid-angle weight M. Paper Eq. 8-12, 15 and 17.

An ERP pixel at latitude t covers a solid angle proportional to cos(t): the image stretches the sphere by 1 / cos(t)
(Eq. 11). The paper turns this into a distortion degree, Omega = 1 - cos^2(t) = sin^2(t) in [0, 1]: 0 on the horizon,
1 at the poles. Latitude is measured in the *camera* frame unless another axis is given.
"""

import math

import torch
from torch import Tensor

from padgs.geometry.panorama import Device, rays, row_latitudes

OMEGA_AXES = ("camera_y", "world_z")


def polar_axis(name: str, cam_from_world: Tensor) -> Tensor:
    """Return the polar axis [3] of latitudes, in the world frame, for a pose [4, 4].

    camera_y is that of the panorama (paper), world_z of the released code: equal if the camera is level on z.
    """
    if name == "camera_y":
        return cam_from_world[1, :3]
    if name == "world_z":
        axis = cam_from_world.new_zeros(3)
        axis[2].fill_(1)  # no transfer to a GPU
        return axis
    raise ValueError(f"unknown omega_axis {name!r}; known: {', '.join(OMEGA_AXES)}")


def distortion(directions: Tensor, axis: Tensor) -> Tensor:
    """Return the distortion degree sin^2(latitude) [...] of unit directions [..., 3] about a unit axis [3] (Eq. 12).

    >>> distortion(torch.tensor([[0.0, -1.0, 0.0], [0.6, 0.8, 0.0]]), torch.tensor([0.0, 1.0, 0.0]))
    tensor([1.0000, 0.6400])
    """
    sine = directions @ axis
    return sine * sine


def distortion_map(width: int, height: int, *, dtype: torch.dtype = torch.float32, device: Device = "cpu") -> Tensor:
    """Return the distortion map, Omega [H, W] at the pixel centres of a panorama."""
    polar = polar_axis("camera_y", torch.eye(4, dtype=dtype, device=device))
    return distortion(rays(width, height, dtype=dtype, device=device), polar)


def opacity_factor(omega: Tensor, tau: float, max_omega: float = 1.0) -> Tensor:
    """Return the factor of opacities at a distortion degree [N]: 1 - tau Omega (Eq. 15).

    PaD-GS multiplies decoded opacities by it when rendering, with tau 0.9 (`PaDGSOptions`). The released code limits
    Omega to `max_omega` = 1 - 1e-4.

    >>> opacity_factor(torch.tensor([0.0, 1.0]), 0.9)
    tensor([1.0000, 0.1000])
    """
    return 1 - tau * omega.clamp(max=max_omega) if tau else torch.ones_like(omega)


def solid_angle_weight(height: int, *, dtype: torch.dtype = torch.float32, device: Device = "cpu") -> Tensor:
    """Return the weight M = cos(latitude) > 0 of each image row, [H], at pixel centres (Eq. 17).

    >>> solid_angle_weight(2)
    tensor([0.7071, 0.7071])
    """
    return torch.cos(row_latitudes(height, dtype=dtype, device=device))


def end_row_weight(height: int, *, dtype: torch.dtype = torch.float32, device: Device = "cpu") -> Tensor:
    """Return the row weight [H] of the released code: cos(pi i / (H - 1) - pi / 2), 0 in the first and last row."""
    rows = torch.arange(height, dtype=dtype, device=device)
    return torch.cos(math.pi * rows / (height - 1) - math.pi / 2).clamp(min=0)  # rounding
