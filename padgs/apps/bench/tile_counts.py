"""Tiles per Gaussian by latitude: exact bounds beside the published ones."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Panorama
from padgs.native.abi import Inputs, pointer
from padgs.render import RenderOptions
from padgs.render.backends.cpu import Projected
from padgs.render.backends.native import native_camera

BANDS = ((0, 30), (30, 60), (60, 75), (75, 85), (85, 90))  # degrees of absolute latitude
SIGMA = 4.0  # pixels at the equator
OPACITY = 0.2
BOUNDS = {
    "exact": RenderOptions(low_pass=0.0),
    "square": RenderOptions(low_pass=0.0, bounds="square", wrap=False),  # as published
}


def tiles_by_latitude(width: int = 2048, height: int = 1024, count: int = 50_000) -> dict[str, Any]:
    """Return mean and maximum of tiles per Gaussian, of all and by band of latitude.

    The Gaussians are isotropic with `SIGMA` and `OPACITY`, in directions uniform on the sphere.
    """
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    latitude = torch.rad2deg(directions[:, 1].clamp(-1, 1).asin()).abs()
    report: dict[str, Any] = {"sigma": SIGMA, "opacity": OPACITY, "width": width, "height": height, "count": count}
    for name, options in BOUNDS.items():
        tiles = tiles_per_gaussian(spheres(directions, SIGMA, width), width, height, options).double()
        bands = {f"{low}-{high}": _statistics(tiles[(latitude >= low) & (latitude < high)]) for low, high in BANDS}
        report[name] = {**_statistics(tiles), "bands": bands}
    return report


def spheres(directions: Tensor, sigma: float, width: int) -> Gaussians:
    """Return isotropic Gaussians at distance 1 in directions [N, 3] from the origin; sigma in pixels at the equator."""
    count = len(directions)
    return Gaussians(
        means=directions,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        scales=torch.full((count, 3), sigma * 2 * math.pi / width),
        opacities=torch.full((count,), OPACITY),
        colors=torch.zeros(count, 3),
    )


def tiles_per_gaussian(gaussians: Gaussians, width: int, height: int, options: RenderOptions) -> Tensor:
    """Return the tile instances [N] of each Gaussian in a panorama at the origin."""
    tensors = [tensor.contiguous() for tensor in vars(gaussians).values()]
    inputs = Inputs(len(gaussians), *map(pointer, tensors), None)
    projected = Projected(native_camera(torch.eye(4), Panorama(width, height), options), inputs, max_instances=1 << 40)
    (strip,) = projected.strips()
    return strip.slot_start.diff()


def _statistics(tiles: Tensor) -> dict[str, Any]:
    return {"mean": float(tiles.mean()), "max": int(tiles.max())} if len(tiles) else {"mean": None, "max": None}
