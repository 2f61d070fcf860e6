"""How large Gaussians are as a camera sees them: what costs pairs in every frame, and is needed by none.

By the distance, not in world units, which would ask the most of what is far. On the CPU it is one native call
(csrc/cpu/angular_size.cpp).
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from padgs.gaussians import Gaussians
from padgs.native import cpu
from padgs.native.abi import AngularSizeArguments, pointer
from padgs.scene import View


def mean_angular_size(gaussians: Gaussians, view: View, *, near: float) -> Tensor:
    """Mean over Gaussians and axes of scale / distance, a scalar; differentiable by the scales alone.

    Args:
        gaussians: one at least.
        view: whose camera sees them.
        near: > 0, no distance is taken to be less, world units.
    """
    means, center = gaussians.means.detach(), view.center.detach().to(gaussians.means)
    if means.device.type == "cpu" and means.dtype == torch.float32 and cpu.available():
        return _AngularSize.apply(gaussians.scales, means, center, near)
    distances = (means - center).norm(dim=-1).clamp(min=near)
    return (gaussians.scales / distances[:, None]).mean()


class _AngularSize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales: Tensor, means: Tensor, center: Tensor, near: float) -> Tensor:
        scales, means = scales.contiguous(), means.contiguous()
        ctx.gradient = torch.empty_like(scales) if ctx.needs_input_grad[0] else None
        scalars = (len(means), (ctypes.c_float * 3)(*center.tolist()), near)
        arguments = AngularSizeArguments(*scalars, *map(pointer, (means, scales, ctx.gradient)))
        return scales.new_tensor(cpu.library().padgs_angular_size(ctypes.byref(arguments)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_size: Tensor):
        return ctx.gradient * grad_size, None, None, None
