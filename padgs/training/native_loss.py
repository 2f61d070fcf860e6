"""Eq. 16 and its derivative in one native call (csrc/cpu/loss.cpp, csrc/cuda/loss.cu).

`padgs.training.loss.photometric_loss` is the definition.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from padgs.native import LIBRARIES, cpu, cuda
from padgs.native.abi import LossArguments, pointer


def fits(image: Tensor) -> bool:
    """Whether a native loss takes this image: float32, three channels, and the library of its device is there."""
    library = LIBRARIES.get(image.device.type)
    if library is None or image.dtype != torch.float32 or image.shape[-1] != 3:
        return False
    return library.works_on(image.device)


def fused_photometric_loss(image: Tensor, target: Tensor, weight: Tensor, lambda_l1: float, total: Tensor) -> Tensor:
    """Eq. 16 over float32 tensors on one device, a scalar; differentiable by `image`.

    Args:
        image, target: [H, W, 3].
        weight: [H, W] or [H, 1].
        lambda_l1: lambda of Eq. 16.
        total: what the weighted sum over pixels and channels is divided by, a scalar.

    Raises:
        ValueError: a target of another shape or type than the image, or tensors on several devices.
    """
    if (target.shape, target.dtype) != (image.shape, image.dtype):  # memory is all that the library sees of them
        raise ValueError(
            f"the target is {target.dtype} of {list(target.shape)}, the image {image.dtype} of {list(image.shape)}; "
            "give both alike"
        )
    devices = {str(tensor.device): None for tensor in (image, target, weight, total)}
    if len(devices) > 1:
        raise ValueError(f"image, target, weight and total are on {', '.join(devices)}; bring them to one device")
    return _FusedLoss.apply(image, target, weight, lambda_l1, total, EVALUATIONS[image.device.type])


class _FusedLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, image: Tensor, target: Tensor, weight: Tensor, lambda_l1: float, total: Tensor, evaluate: Callable
    ) -> Tensor:
        height, width, _ = image.shape
        image, target = image.contiguous(), target.contiguous()
        weight = weight.to(torch.float32).expand(height, width)
        ctx.gradient = torch.empty_like(image) if ctx.needs_input_grad[0] else None
        arguments = LossArguments(width, height, pointer(image), pointer(target), weight.data_ptr(), *weight.stride())
        arguments.lambda_l1, arguments.gradient = lambda_l1, pointer(ctx.gradient)
        return evaluate(arguments, image, total)

    @staticmethod
    def backward(ctx: Any, grad_loss: Tensor):
        return ctx.gradient * grad_loss, None, None, None, None, None


def _on_cpu(arguments: LossArguments, image: Tensor, total: Tensor) -> Tensor:
    arguments.normalizer, arguments.workspace = 1 / float(total), pointer(_workspace(*image.shape[:2]))
    return image.new_tensor(cpu.library().padgs_photometric_loss(ctypes.byref(arguments)))


@functools.lru_cache(maxsize=2)
def _workspace(height: int, width: int) -> Tensor:
    # Kept between iterations: fresh memory costs more in page faults than the loss does in arithmetic. Python threads
    # would share it: one at a time may train.
    return torch.zeros(cpu.library().padgs_loss_workspace(height, width), dtype=torch.float32)


def _on_gpu(arguments: LossArguments, image: Tensor, total: Tensor) -> Tensor:
    """The host waits for nothing: what to divide by stays on the device, and so does the loss."""
    height, width, _ = image.shape
    total = total.to(torch.float32)
    partials = None if arguments.gradient is None else image.new_empty(3, height, width, 3)
    sums = image.new_empty(cuda.library().padgs_cuda_loss_blocks(height, width))
    arguments.workspace = pointer(partials)
    device_arguments = cuda.DeviceLossArguments(arguments, pointer(total), pointer(sums))
    cuda.call("padgs_cuda_photometric_loss", cuda.queue(image.device), device_arguments)
    return (sums.sum(dtype=torch.float64) / total).to(torch.float32)


EVALUATIONS = {"cpu": _on_cpu, "cuda": _on_gpu}  # by the type of the device
