"""Distances that grow exponentially: the radial nodes of the grids, and the first samples along a ray."""

from __future__ import annotations

import torch
from torch import Tensor


def exponential_nodes(first: float, last: float, count: int) -> Tensor:
    """Distances 0, first, first q, first q^2, ... `last`, with no interval shorter than `first`, [count] float64.

    Where an interval of the geometric series is shorter than `first` it is replaced by `first`, and all that lies
    behind is shifted outwards to stay continuous (the published interval threshold); so the nodes end at or behind
    `last`.

    Raises:
        ValueError: too few nodes, or lengths that do not grow.

    >>> exponential_nodes(1.0, 4.0, 4).tolist()
    [0.0, 1.0, 2.0, 4.0]
    """
    if count < 3:
        raise ValueError(f"{count} radial nodes are too few; there must be at least 3")
    if not 0 < first < last:
        raise ValueError(f"the first radius is {first} and the last {last}; they must be 0 < first < last")
    steps = torch.arange(count - 1, dtype=torch.float64)
    nodes = first * (last / first) ** (steps / (count - 2))
    intervals = torch.cat((nodes[:1], nodes.diff())).clamp(min=first)
    return torch.cat((torch.zeros(1, dtype=torch.float64), intervals.cumsum(0)))


def node_fraction(radius: Tensor, nodes: Tensor) -> Tensor:
    """Place of radii [...] among increasing nodes [N], piecewise linear: 0 at the first, 1 at the last and behind.

    Args:
        radius: any shape.
        nodes: [N] of the same dtype.
    """
    last = len(nodes) - 1
    upper = torch.searchsorted(nodes, radius.contiguous(), right=True).clamp(1, last)
    below, above = nodes[upper - 1], nodes[upper]
    return ((upper - 1 + (radius - below) / (above - below)) / last).clamp(0, 1)
