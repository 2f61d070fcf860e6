"""Where along a ray the field is looked at, and which share of what is seen comes from which interval.

The first look is at distances that grow exponentially, the second where the first found something.
"""

from __future__ import annotations

import torch
from torch import Tensor

FLOOR = 1e-5  # added to every weight, so that a ray through nothing is still sampled everywhere


def jittered(distances: Tensor, random: Tensor) -> Tensor:
    """Distances [..., S], each moved by its share `random` [..., S] in [0, 1) of the interval that follows it."""
    return distances + interval_lengths(distances) * random


def interval_lengths(distances: Tensor) -> Tensor:
    """Length [..., S] of the interval that each distance [..., S] begins; the last is as long as the one before.

    >>> interval_lengths(torch.tensor([1.0, 2.0, 5.0])).tolist()
    [1.0, 3.0, 3.0]
    """
    lengths = distances.diff(dim=-1)
    return torch.cat((lengths, lengths[..., -1:]), dim=-1)


def refined(distances: Tensor, weights: Tensor, shares: Tensor) -> Tensor:
    """Distances of further samples: quantiles of the weights that the first ones got.

    Args:
        distances: [B, S] increasing.
        weights: [B, S] >= 0; weight k is taken to lie between the midpoints around distance k, the outer two are not.
        shares: [B, F] in [0, 1], of the total weight.

    Returns:
        [B, F].
    """
    midpoints = (distances[:, 1:] + distances[:, :-1]) / 2
    return inverse_cdf(midpoints, weights[:, 1:-1] + FLOOR, shares)


def inverse_cdf(edges: Tensor, weights: Tensor, shares: Tensor) -> Tensor:
    """Quantiles of a piecewise constant density.

    Args:
        edges: [B, M + 1] increasing, of the pieces.
        weights: [B, M] > 0, mass of each piece up to a factor.
        shares: [B, F] in [0, 1].

    Returns:
        [B, F]: the places below which a `shares` of the mass lies.

    >>> inverse_cdf(torch.tensor([[0.0, 1.0, 2.0]]), torch.tensor([[1.0, 3.0]]), torch.tensor([[0.25, 0.625]])).tolist()
    [[1.0, 1.5]]
    """
    cumulative = torch.cat((torch.zeros_like(weights[:, :1]), weights.cumsum(-1)), dim=-1)
    mass = (shares * cumulative[:, -1:]).contiguous()
    piece = torch.searchsorted(cumulative, mass, right=True).clamp(1, weights.shape[1]) - 1
    below, weight = cumulative.gather(1, piece), weights.gather(1, piece)
    low, high = edges.gather(1, piece), edges.gather(1, piece + 1)
    return low + (high - low) * ((mass - below) / weight).clamp(0, 1)


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
