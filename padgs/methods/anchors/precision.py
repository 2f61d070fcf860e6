"""Matrix products of the networks in a reduced floating-point type, for tensor cores.

Parameters and results stay float32; operands are rounded for the product, which is summed in float32 and rounded once.
torch on a GPU may round partial sums too (`torch.backends.cuda.matmul.allow_bf16_reduced_precision_reduction`, on by
default); the kernels of `padgs.methods.anchors.native_decoder` do not. Products of gradients are always taken in
bfloat16: gradients of a mean over pixels are below the smallest numbers of float16.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

PRECISIONS = ("float32", "bfloat16", "float16")
GRADIENT_TYPE = torch.bfloat16


def reduced_dtype(precision: str) -> torch.dtype | None:
    """Return the type of a precision; None for float32, the tensors' own type."""
    if precision not in PRECISIONS:
        raise ValueError(f"unknown precision {precision!r}; known: {', '.join(PRECISIONS)}")
    return None if precision == "float32" else getattr(torch, precision)


def linear(inputs: Tensor, weight: Tensor, bias: Tensor, dtype: torch.dtype | None) -> Tensor:
    """Apply a layer of weight [O, I] and bias [O] to inputs [A, I] with a product in `dtype`, None: their type."""
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
        inputs, weight = (tensor.to(GRADIENT_TYPE) for tensor in ctx.saved_tensors)
        rounded = grad.to(GRADIENT_TYPE)
        return (rounded @ weight).to(grad.dtype), (rounded.T @ inputs).to(grad.dtype), grad.sum(0), None
