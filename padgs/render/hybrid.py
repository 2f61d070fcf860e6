"""Hybrid transparency (torch): a sorted core of the nearest fragments of a pixel, and an order-independent tail.

Published with SPaGS. The order is that of the fragments on the pixel's own ray, so that nothing pops when the order of
the means changes, and no list needs to be sorted; the price is a tail whose order is lost.
"""

from __future__ import annotations

import torch
from torch import Tensor

from padgs.render.contract import CORE_ALPHA_MIN, TRANSMITTANCE_MIN


def hybrid_weights(alpha: Tensor, distance: Tensor, core_size: int) -> tuple[Tensor, Tensor]:
    """How much each fragment contributes to its pixel, and what is left for the background.

    The core are the `core_size` nearest fragments with alpha >= 0.05, blended front to back until less than 1e-4 is
    left, which then counts as nothing. All others are the tail. With T what the core leaves, Z and Q the sum of alpha
    and the product of 1 - alpha over the tail, the tail lies behind the core as one layer of opacity 1 - Q whose colour
    is the mean weighted by alpha: a tail fragment has the weight T (1 - Q) alpha / Z. Who is in the core is a constant
    to autograd.

    Args:
        alpha: [P, K] of every pixel and Gaussian, 0 where nothing is drawn.
        distance: [P, K] along the ray, no gradient; ties are won by the first in the list.
        core_size: at least 1.

    Returns:
        weights [P, K] >= 0 and transmittance [P], which sum to 1 (to within 1e-4 where the core ended early).
    """
    solid = alpha.detach() >= CORE_ALPHA_MIN
    key = torch.where(solid, distance, torch.full_like(distance, torch.inf))
    nearest = torch.argsort(key, dim=-1, stable=True)[:, :core_size]
    in_core = torch.zeros_like(solid).scatter(1, nearest, solid.gather(1, nearest))
    none = torch.zeros_like(alpha)

    core = torch.where(in_core, alpha, none).gather(1, nearest)  # front to back
    after = torch.cumprod(1 - core, dim=-1)
    after = torch.where(after.detach() >= TRANSMITTANCE_MIN, after, torch.zeros_like(after))
    after = torch.cat((alpha.new_ones(len(alpha), 1), after), dim=-1)  # before each and behind the last
    core_weights = none.scatter(1, nearest, core * after[:, :-1])
    through = after[:, -1]

    tail = torch.where(in_core, none, alpha)
    left = torch.prod(1 - tail, dim=-1)
    total = tail.sum(-1)  # 0, or at least 1/255 as every fragment is
    share = through * (1 - left) / torch.where(total > 0, total, torch.ones_like(total))
    return core_weights + tail * share[:, None], through * left
