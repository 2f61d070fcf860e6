"""Matrix products of small networks in a reduced floating-point type: what tensor cores are for.

Parameters and results stay float32; operands are rounded for the product, which is summed in float32 and rounded once.
(Where torch multiplies on a GPU, partial sums may be rounded too:
`torch.backends.cuda.matmul.allow_bf16_reduced_precision_reduction`, on by default, and the same for float16. The
kernels of `padgs.methods.anchors.fused_decoder` round none, and sum gradients without rounding the result.)
Products of gradients are taken in bfloat16 whatever the type: those of a mean over pixels are smaller than float16's
numbers begin.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

PRECISIONS = ("float32", "bfloat16", "float16")
OF_GRADIENTS = torch.bfloat16


def reduced(precision: str) -> torch.dtype | None:
    """The type that a precision stands for; None for float32, which is to say the tensors' own.

    Raises:
        ValueError: an unknown precision; the message lists the known ones.
    """
    if precision not in PRECISIONS:
        raise ValueError(f"unknown precision {precision!r}; known: {', '.join(PRECISIONS)}")
    return None if precision == "float32" else getattr(torch, precision)


def linear(inputs: Tensor, weight: Tensor, bias: Tensor, dtype: torch.dtype | None) -> Tensor:
    """Inputs [A, I] through a layer of weight [O, I] and bias [O]; differentiable by all three.

    Args:
        inputs, weight, bias: of one type, which is the result's too.
        dtype: what the product is taken in; None: as they are.
    """
    if dtype is None:
        return torch.addmm(bias, inputs, weight.T)
    return _ReducedLinear.apply(inputs, weight, bias, dtype)


class _ReducedLinear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor, dtype: torch.dtype) -> Tensor:
        ctx.save_for_backward(inputs, weight)
        return torch.addmm(bias.to(dtype), inputs.to(dtype), weight.to(dtype).T).to(inputs.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor):
        inputs, weight = (tensor.to(OF_GRADIENTS) for tensor in ctx.saved_tensors)
        rounded = grad.to(OF_GRADIENTS)
        return (rounded @ weight).to(grad.dtype), (rounded.T @ inputs).to(grad.dtype), grad.sum(0), None
