"""Eq. 16 and its derivative in one native call (csrc/loss.cpp); `padgs.loss.photometric_loss` is the definition."""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import torch
from torch import Tensor

from padgs.render import native
from padgs.render.native import pointer


def fits(image: Tensor) -> bool:
    """Whether the native loss takes this image: float32, on the CPU, three channels, and the library is there."""
    plain = image.dtype == torch.float32 and image.device.type == "cpu" and image.shape[-1] == 3
    return plain and native.available()


def fused_photometric_loss(image: Tensor, target: Tensor, weight: Tensor, lambda_l1: float, total: float) -> Tensor:
    """Eq. 16 over float32 tensors on the CPU, a scalar; differentiable by `image`.

    Args:
        image, target: [H, W, 3].
        weight: [H, W] or [H, 1].
        lambda_l1: lambda of Eq. 16.
        total: what the weighted sum over pixels and channels is divided by.
    """
    return _FusedLoss.apply(image, target, weight, lambda_l1, total)


class _FusedLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, weight: Tensor, lambda_l1: float, total: float) -> Tensor:
        height, width, _ = image.shape
        image, target = image.contiguous(), target.contiguous()
        weight = weight.to(torch.float32).expand(height, width)
        gradient = torch.empty_like(image) if ctx.needs_input_grad[0] else None
        arguments = native.LossArguments(
            width,
            height,
            pointer(image),
            pointer(target),
            weight.data_ptr(),
            *weight.stride(),
            lambda_l1,
            1 / total,
            pointer(_workspace(height, width)),
            pointer(gradient),
        )
        loss = native.library().padgs_photometric_loss(ctypes.byref(arguments))
        ctx.gradient = gradient
        return image.new_tensor(loss)

    @staticmethod
    def backward(ctx: Any, grad_loss: Tensor):
        return ctx.gradient * grad_loss, None, None, None, None


@functools.lru_cache(maxsize=2)
def _workspace(height: int, width: int) -> Tensor:
    # Kept between iterations: fresh memory costs more in page faults than the loss does in arithmetic.
    return torch.zeros(native.library().padgs_loss_workspace(height, width))
