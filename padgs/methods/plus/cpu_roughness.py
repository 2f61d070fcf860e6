"""The roughness of a drawing and its derivative in one native call (csrc/cpu/roughness.cpp).

`padgs.methods.plus.smoothness.roughness` is the definition.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from padgs.native import cpu
from padgs.native.abi import RoughnessArguments, pointer
from padgs.render import Rendering

LEAST = 3  # pixels across and down: neighbours on both sides


def fits(rendering: Rendering) -> bool:
    """Whether there is a native pass for it: float32 on the CPU, a picture with neighbours, a library."""
    shape, parts = rendering.depth.shape, (rendering.depth, rendering.transmittance, rendering.image)
    plain = all(part.device.type == "cpu" and part.dtype == torch.float32 for part in parts)
    alike = rendering.transmittance.shape == shape and rendering.image.shape == (*shape, 3)
    return plain and alike and min(shape) >= LEAST and cpu.available()


def native_roughness(
    rendering: Rendering, rows: Tensor, *, around: bool, near: float, edges: float, jump: float
) -> Tensor:
    """A scalar, differentiable by `rendering.depth`.

    Args:
        rendering: of [H, W] pixels that `fits`.
        rows: [H] what the pixels of each row count.
        around: whether the left and the right end of a row are neighbours.
        near: > 0, in the unit of the distances; none is taken to be less.
        edges, jump: `EDGES` and `JUMP` of the definition.
    """
    return _Roughness.apply(rendering.depth, rendering.image, rendering.transmittance, rows, around, near, edges, jump)


class _Roughness(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, depth: Tensor, image: Tensor, transmittance: Tensor, rows: Tensor, around: bool, *scalars: float
    ) -> Tensor:
        height, width = depth.shape
        inputs = [tensor.contiguous() for tensor in (image, transmittance, depth, rows)]
        ctx.gradient = torch.empty_like(inputs[2]) if ctx.needs_input_grad[0] else None
        tensors = map(pointer, (*inputs, _workspace(height, width), ctx.gradient))
        arguments = RoughnessArguments(width, height, around, *scalars, *tensors)
        return depth.new_tensor(cpu.library().padgs_roughness(ctypes.byref(arguments)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor):
        return ctx.gradient * grad_loss, *[None] * 7


@functools.lru_cache(maxsize=2)
def _workspace(height: int, width: int) -> Tensor:
    # Kept as that of `padgs.training.loss` is, so only one thread at a time may train.
    return torch.zeros(cpu.library().padgs_roughness_workspace(height, width), dtype=torch.float32)
