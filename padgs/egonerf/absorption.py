"""Light along a ray through a medium: which share of what is seen comes from which interval."""

from __future__ import annotations

import torch
from torch import Tensor


def visible_shares(optical_depths: Tensor) -> tuple[Tensor, Tensor]:
    """Share of each interval in what a ray sees, and of what lies behind all of them; together 1.

    weight_k = exp(-sum of the depths in front) (1 - exp(-depth_k)), exact for intervals of constant density.

    Args:
        optical_depths: [..., S] >= 0, density times length of the intervals, from front to back.

    Returns:
        weights [..., S], residual [...].

    >>> weights, residual = visible_shares(torch.tensor([0.6931472, 0.6931472]))
    >>> weights.tolist(), residual.item()
    ([0.5, 0.25], 0.25)
    """
    behind = torch.exp(-optical_depths.cumsum(-1))
    front = torch.cat((torch.ones_like(behind[..., :1]), behind[..., :-1]), dim=-1)
    return front * -torch.expm1(-optical_depths), behind[..., -1]
