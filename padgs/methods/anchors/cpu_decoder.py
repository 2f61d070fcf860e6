"""Decoding anchors into Gaussians in one native pass each way (csrc/cpu/decode.cpp).

`padgs.methods.anchors.decoder` is the definition; `padgs.methods.anchors.gpu_decoder` fills the same structure.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from padgs.native import cpu
from padgs.native.abi import DecodeArguments, DecodeGradientArguments, HeadWeights, pointer

OPACITY_VALUES, COLOR_VALUES, COVARIANCE_VALUES = 1, 3, 7  # outputs of each network per Gaussian
SIZES = (3, 4, 3, 0, 3)  # values per Gaussian of means, quats, scales, opacities, colors; 0 = a scalar


def decode_on_cpu(weights: tuple[Tensor, ...], *tensors: Tensor) -> tuple[Tensor, ...]:
    """Means, quaternions, scales, opacities, colours, slots and raw opacities of the selected Gaussians.

    Differentiable by weights, features, offsets and log-scales; the rest are constants.

    Args:
        weights: the twelve tensors of the networks in a row, float32.
        tensors: from features to attenuation, as `padgs.methods.anchors.decoder.decode_gaussians` takes them.
    """
    return _DecodeOnCPU.apply(*tensors, *weights)


class _DecodeOnCPU(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features, seen, positions, offsets, log_scales, attenuation, *weights):
        inputs = torch.cat((features.detach(), seen), dim=-1)
        constants = [t.detach().contiguous() for t in (positions, offsets, log_scales, attenuation)]
        weights = [w.detach().contiguous() for w in weights]
        anchors, per_anchor = offsets.shape[:2]
        raw = torch.empty(anchors, per_anchor)
        starts = torch.empty(anchors + 1, dtype=torch.int64)
        nowhere = [None] * len(SIZES)
        arguments = decode_arguments(constants, raw, starts, None, nowhere, inputs, weights)
        cpu.library().padgs_decode_select(ctypes.byref(arguments))
        count = int(starts[-1])
        slots = torch.empty(count, dtype=torch.int64)
        outputs = [torch.empty((count, size) if size else count) for size in SIZES]
        arguments = decode_arguments(constants, raw, starts, slots, outputs, inputs, weights)
        cpu.library().padgs_decode_place(ctypes.byref(arguments))
        ctx.save_for_backward(inputs, *weights, *constants, raw, starts, slots, *outputs)
        ctx.features = features.shape[1]
        ctx.mark_non_differentiable(slots, raw)
        return *outputs, slots, raw

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor):
        inputs, *saved = ctx.saved_tensors
        weights, constants, (raw, starts, slots), outputs = saved[:12], saved[12:16], saved[16:19], saved[19:]
        upstream = [grad.contiguous() for grad in grads[: len(SIZES)]]
        offsets, log_scales = constants[1:3]
        grad_features = torch.empty(len(offsets), ctx.features)
        grad_offsets, grad_log_scales = torch.empty_like(offsets), torch.empty_like(log_scales)
        sizes = [w.numel() for w in weights]
        grad_weights = torch.empty(sum(sizes))
        arguments = DecodeGradientArguments(
            decode_arguments(constants, raw, starts, slots, outputs, inputs, weights),
            *map(pointer, upstream),
            ctx.features,
            *map(pointer, (grad_features, grad_offsets, grad_log_scales, grad_weights)),
        )
        cpu.library().padgs_decode_backward(ctypes.byref(arguments))
        of_weights = (part.view_as(w) for part, w in zip(grad_weights.split(sizes), weights, strict=True))
        return grad_features, None, None, grad_offsets, grad_log_scales, None, *of_weights


def decode_arguments(
    constants: Sequence[Tensor],
    raw: Tensor,
    starts: Tensor,
    slots: Tensor | None,
    outputs: Sequence[Tensor | None],
    inputs: Tensor | None = None,
    weights: Sequence[Tensor] = (),
) -> DecodeArguments:
    """For a library; without inputs for that of a GPU, and without weights where it does not see the networks."""
    heads = [HeadWeights(*map(pointer, weights[first : first + 4])) for first in (0, 4, 8)]
    hidden, width = weights[0].shape if weights else (0, 0)
    buffers = (inputs, *constants, raw, starts, slots, *outputs)
    return DecodeArguments(*raw.shape, width, hidden, *heads, *map(pointer, buffers))
