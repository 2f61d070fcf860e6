"""The colours of explicit Gaussians and their derivatives in one native call each (csrc/cpu/colors.cpp).

`padgs.splats.model.Splats` has the definition.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from padgs.native import cpu
from padgs.native.abi import ColorArguments, pointer


def fits(means: Tensor, center: Tensor) -> bool:
    """Whether there is a native pass for these: float32 on the CPU, a camera that does not learn, a library."""
    on_cpu = means.device.type == "cpu" and means.dtype == torch.float32
    return on_cpu and not center.requires_grad and cpu.available()


def native_colors(means: Tensor, dc: Tensor, rest: Tensor, degree: int, center: Tensor, tiny: float) -> Tensor:
    """Max(0, 1/2 + SH), [N, 3], differentiable by means and coefficients.

    Args:
        means: [N, 3] world.
        dc: [N, 3] coefficients of degree 0.
        rest: [N, K, 3] of the degrees from 1 on.
        degree: that is in use.
        center: [3] of the camera, world.
        tiny: what is added to distances, in squares; world units.
    """
    return _Colors.apply(means, dc, rest, degree, center, tiny)


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, dc: Tensor, rest: Tensor, degree: int, center: Tensor, tiny: float) -> Tensor:
        inputs = [tensor.contiguous() for tensor in (means, dc, rest)]
        ctx.scalars = (len(means), degree, rest.shape[1], (ctypes.c_float * 3)(*center.tolist()), tiny)
        colors = torch.empty_like(inputs[1])
        ctx.save_for_backward(*inputs, colors)
        cpu.library().padgs_colors(ctypes.byref(ColorArguments(*ctx.scalars, *map(pointer, (*inputs, colors)))))
        return colors

    @staticmethod
    def backward(ctx: Any, grad_colors: Tensor):
        means, dc, rest, _ = saved = ctx.saved_tensors
        grad_colors = grad_colors.contiguous()
        gradients = [torch.empty_like(tensor) for tensor in (means, dc, rest)]
        tensors = map(pointer, (*saved, grad_colors, *gradients))
        cpu.library().padgs_colors(ctypes.byref(ColorArguments(*ctx.scalars, *tensors)))
        return *gradients, None, None, None
