"""A panoramic camera that is not quite ideal: where each direction of the ideal panorama lies in its photographs.

The camera model of SC-OmniGS as far as it is known: a grid S of unit directions, a focal-type coefficient f and an
angular distortion map D of the size of the image. The ideal pixel p is found in the photograph at
pi(normalize(f * S(p) + D(p))), pi the equirectangular projection. Per-axis f, the fixed gauge and the roughness are
ours (docs/methods.md).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from padgs.geometry.distortion import solid_angle_weight
from padgs.geometry.panorama import project, rays, sample_pixels

INVERSE_STEPS = 8  # each leaves the error times about the derivative of D


class CameraMap(nn.Module):
    """One camera, shared by all views.

    Attributes:
        focal: [3] f, one per camera axis; a common factor means nothing as long as D is small.
        offsets: [H, W, 3] D, camera frame, radians where it is orthogonal to the direction.
    """

    _rays: Tensor  # [H, W, 3]
    _weight: Tensor  # [H, 1, 1]
    _centers: Tensor  # [H, W, 2]
    _pixels: Tensor  # [H, W, 2]

    def __init__(self, width: int, height: int, *, dtype: torch.dtype = torch.float32) -> None:
        """The ideal camera."""
        super().__init__()
        self.width, self.height = width, height
        self.focal = nn.Parameter(torch.ones(3, dtype=dtype))
        self.offsets = nn.Parameter(torch.zeros(height, width, 3, dtype=dtype))
        directions = rays(width, height, dtype=dtype)
        weight = solid_angle_weight(height, dtype=dtype)[:, None, None]
        columns, rows = (torch.arange(n, dtype=dtype) + 0.5 for n in (width, height))
        self.register_buffer("_rays", directions, persistent=False)
        self.register_buffer("_weight", weight / weight.sum(), persistent=False)  # of rows; sums to 1
        self.register_buffer(
            "_centers", torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1), persistent=False
        )
        # Through the same arithmetic as below, so that an ideal camera moves no pixel by a single bit.
        self.register_buffer("_pixels", project(normalize(directions, dim=-1), width, height), persistent=False)

    def directions(self) -> Tensor:
        """Where the photograph shows what the ideal panorama shows at each pixel: unit directions [H, W, 3]."""
        return normalize(self.focal * self._rays + self._free_offsets(), dim=-1)

    def source_pixels(self) -> Tensor:
        """The same as pixels (u, v) of the photograph [H, W, 2]; pixel centres, exactly, where the camera is ideal."""
        return self._pixels_of(self.directions())

    @torch.no_grad()
    def ideal_pixels(self) -> Tensor:
        """The inverse: pixels (u, v) [H, W, 2] of the ideal panorama that the photograph shows at each of its own.

        Solved by fixed-point iteration, which converges where D is smooth and small (a few degrees).
        """
        targets = normalize(self._rays, dim=-1)
        offsets, found = self._free_offsets(), targets
        for _ in range(INVERSE_STEPS):
            reached = normalize(self.focal * found + sample_pixels(offsets, self._pixels_of(found)), dim=-1)
            found = normalize(found + (targets - reached), dim=-1)
        return self._pixels_of(found)

    def roughness(self) -> Tensor:
        """Total variation of D per radian, the mean over the sphere; a scalar."""
        d = self.offsets
        # East a step is cos(latitude) shorter and varies more per radian, but so much smaller is its solid angle.
        across = (d.roll(-1, dims=1) - d).abs().sum(-1).mean() * (self.width / 4)
        down = (d[1:] - d[:-1]).abs().sum(-1).mean(1) * (self.height / math.pi)
        weight = self._weight[:, 0, 0]
        return across + (down * (weight[1:] + weight[:-1]) / 2).sum()  # a step is between two rows

    def _free_offsets(self) -> Tensor:
        """D without its mean rotation, which is that of all cameras: poses and D could shift it to and fro forever."""
        turn = 1.5 * (self._weight * torch.linalg.cross(self._rays, self.offsets)).mean(1).sum(0)
        return self.offsets - torch.linalg.cross(turn.expand_as(self._rays), self._rays)

    def _pixels_of(self, directions: Tensor) -> Tensor:
        """Pixels (u, v) [H, W, 2] of directions [H, W, 3], each the short way around from its own pixel."""
        moved = project(directions, self.width, self.height) - self._pixels
        turns = torch.round(moved[..., 0].detach() / self.width)
        return self._centers + moved - torch.stack((turns * self.width, torch.zeros_like(turns)), dim=-1)
