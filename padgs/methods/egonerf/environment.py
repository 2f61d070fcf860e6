"""What lies behind everything: a picture of the whole sphere in which all texels cover the same solid angle."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional


class EnvironmentMap(nn.Module):
    """Colours by direction: rows of equal steps of z, columns of equal steps of azimuth, bilinear, through a sigmoid.

    Texel (i, j) of the H x 2H is centred at z = (2 i + 1) / H - 1 and azimuth = ((2 j + 1) / 2H - 1) pi; the picture
    is continuous across the +-180 degrees azimuth.
    """

    def __init__(self, height: int) -> None:
        """H rows, uniform in [0, 1) before the sigmoid at first."""
        super().__init__()
        self.emission = nn.Parameter(torch.rand(3, height, 2 * height))

    def forward(self, directions: Tensor) -> Tensor:
        """Colours [N, 3] in (0, 1) of unit directions [N, 3]."""
        x, y, z = directions.unbind(-1)
        width = self.emission.shape[2]
        padded = torch.cat((self.emission[..., -1:], self.emission, self.emission[..., :1]), dim=-1)
        places = torch.stack((torch.atan2(y, x) / math.pi * (width / (width + 2)), z), dim=-1)[None, :, None]
        values = functional.grid_sample(padded[None], places, align_corners=False, padding_mode="border")
        return torch.sigmoid(values[0, :, :, 0].T)
