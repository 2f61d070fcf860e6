"""How hard the pixels pull at a Gaussian, each by itself (torch): a densification signal in which nothing cancels.

The gradient of a mean is a sum over pixels, and two pixels that pull at opposite sides of a Gaussian leave nothing of
it, although it is just such a Gaussian that should become two. The absolute signal sums the norms instead,

    sum over pixels p of |dL/dq_p| |dq_p/dmean|,

q the squared distance of the footprint (Gaussian Opacity Fields and AbsGS do so with the gradient on the image, each
coordinate by itself; norms of vectors do not depend on how the axes lie). It is no gradient of anything, but travels as
one: as that of a probe which changes nothing.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def with_absolute_pull(q: Tensor, slope: Tensor, probe: Tensor) -> Tensor:
    """The same q; the backward pass leaves the absolute signal as the gradient of the probe.

    Args:
        q: [P, K] squared distances of pixels and Gaussians.
        slope: [P, K] |dq/dmean| without a gradient, per world unit.
        probe: [K], any values.
    """
    return _WithAbsolutePull.apply(q, slope, probe)


class _WithAbsolutePull(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, q: Tensor, slope: Tensor, _probe: Tensor) -> Tensor:
        ctx.save_for_backward(slope)
        return q.view_as(q)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_q: Tensor):
        (slope,) = ctx.saved_tensors
        return grad_q, None, (grad_q.abs() * slope).sum(0)
