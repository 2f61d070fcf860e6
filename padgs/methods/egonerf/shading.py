"""Colour from the appearance grids: a linear basis for each chart, then a network that also sees the direction."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from padgs.methods.egonerf.charts import YANG, YIN
from padgs.methods.egonerf.options import EgoNeRFOptions
from padgs.methods.egonerf.plane_lines import CHARTS, MODES


class Shader(nn.Module):
    """Products of planes and lines, and a viewing direction -> RGB in (0, 1)."""

    def __init__(self, options: EgoNeRFOptions) -> None:
        super().__init__()
        self.options, features, hidden = options, options.features, options.hidden
        inputs = len(MODES) * options.appearance_components
        bound = 1 / math.sqrt(inputs)
        self.basis = nn.Parameter(torch.empty(CHARTS, features, inputs).uniform_(-bound, bound))
        width = features * (1 + 2 * options.feature_frequencies) + 3 * (1 + 2 * options.direction_frequencies)
        last = nn.Linear(hidden, 3)
        nn.init.zeros_(last.bias)
        self.network = nn.Sequential(
            nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), last, nn.Sigmoid()
        )

    def forward(self, products: Sequence[Tensor], chart: Tensor, directions: Tensor) -> Tensor:
        """Colours [N, 3].

        Args:
            products: [C, N] of each mode, see `plane_lines.products`.
            chart: [N] of the places.
            directions: [N, 3] unit, of the rays.
        """
        stacked = torch.cat(list(products))
        features = torch.where(chart == YANG, self.basis[YANG] @ stacked, self.basis[YIN] @ stacked).T
        seen = encoding(directions, self.options.direction_frequencies)
        return self.network(torch.cat((encoding(features, self.options.feature_frequencies), seen), dim=-1))


def encoding(values: Tensor, frequencies: int) -> Tensor:
    """values [N, D] with the sines and cosines of 1, 2, 4, ... times them, [N, D (1 + 2 frequencies)].

    >>> encoding(torch.zeros(1, 1), 2).tolist()
    [[0.0, 0.0, 0.0, 1.0, 1.0]]
    """
    factors = 2.0 ** torch.arange(frequencies, dtype=values.dtype, device=values.device)
    angles = (values[..., None] * factors).flatten(-2)
    return torch.cat((values, angles.sin(), angles.cos()), dim=-1)
