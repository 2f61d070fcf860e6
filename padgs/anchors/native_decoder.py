"""Decoding anchors into Gaussians in one native pass each way (csrc/cpu/decode.cpp).

`padgs.anchors.decoder` is the definition.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from padgs.anchors.gpu_decoder import decode_on_gpu
from padgs.native import cpu, cuda
from padgs.native.abi import DecodeArguments, DecodeGradientArguments, HeadWeights, pointer

OUTPUTS = {"means": 3, "quats": 4, "scales": 3, "opacities": 0, "colors": 3}  # values per Gaussian, 0 = a scalar


def fits(inputs: Tensor, dtype: torch.dtype | None = None) -> bool:
    """Whether a native decoder takes these inputs, with products in a reduced type: float32 tensors, and the library of
    their device is there; the CPU's has no reduced types."""
    library = {"cpu": None if dtype else cpu, "cuda": cuda}.get(inputs.device.type)
    return library is not None and inputs.dtype == torch.float32 and library.available()


def fused_decode(
    weights: tuple[Tensor, ...],
    features: Tensor,
    seen: Tensor,
    positions: Tensor,
    offsets: Tensor,
    log_scales: Tensor,
    attenuation: Tensor,
    dtype: torch.dtype | None = None,
) -> tuple[Tensor, ...]:
    """Means, quaternions, scales, opacities, colours, slots and raw opacities of the selected Gaussians.

    Arguments and results are those of `padgs.anchors.decoder.decode_gaussians`, with the twelve tensors of the weights
    in a row, and the reduced type of their products. Differentiable by weights, features, offsets and log-scales; the
    rest are constants.
    """
    if features.device.type == "cuda":
        return decode_on_gpu(weights, features, seen, positions, offsets, log_scales, attenuation, dtype=dtype)
    return _FusedDecode.apply(features, seen, positions, offsets, log_scales, attenuation, *weights)


class _FusedDecode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features, seen, positions, offsets, log_scales, attenuation, *weights):
        inputs = torch.cat((features.detach(), seen), dim=-1)
        constants = [t.detach().contiguous() for t in (inputs, positions, offsets, log_scales, attenuation)]
        weights = [w.detach().contiguous() for w in weights]
        anchors, per_anchor = offsets.shape[:2]
        raw = torch.empty(anchors, per_anchor)
        slot_start = torch.empty(anchors + 1, dtype=torch.int64)
        arguments = _arguments(weights, constants, raw, slot_start)
        cpu.library().padgs_decode_select(ctypes.byref(arguments))
        count = int(slot_start[-1])
        slots = torch.empty(count, dtype=torch.int64)
        outputs = [torch.empty((count, size) if size else count) for size in OUTPUTS.values()]
        arguments = _arguments(weights, constants, raw, slot_start, slots, outputs)
        cpu.library().padgs_decode_place(ctypes.byref(arguments))
        ctx.save_for_backward(*weights, *constants, raw, slot_start, slots, *outputs)
        ctx.features = features.shape[1]
        ctx.mark_non_differentiable(slots, raw)
        return *outputs, slots, raw

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor):
        saved = ctx.saved_tensors
        weights, constants, (raw, slot_start, slots), outputs = saved[:12], saved[12:17], saved[17:20], saved[20:]
        _, _, offsets, log_scales, _ = constants
        upstream = [grad.contiguous() for grad in grads[: len(OUTPUTS)]]
        grad_features = torch.empty(len(offsets), ctx.features)
        grad_offsets, grad_log_scales = torch.empty_like(offsets), torch.empty_like(log_scales)
        grad_weights = torch.empty(sum(w.numel() for w in weights))
        forward = _arguments(weights, constants, raw, slot_start, slots, outputs)
        arguments = DecodeGradientArguments(
            forward,
            *map(pointer, upstream),
            ctx.features,
            *map(pointer, (grad_features, grad_offsets, grad_log_scales, grad_weights)),
        )
        cpu.library().padgs_decode_backward(ctypes.byref(arguments))
        parts = grad_weights.split([w.numel() for w in weights])
        return (
            grad_features,
            None,
            None,
            grad_offsets,
            grad_log_scales,
            None,
            *(part.view_as(w) for part, w in zip(parts, weights, strict=True)),
        )


def _arguments(weights, constants, raw, slot_start, slots=None, outputs=None):
    outputs = [None] * len(OUTPUTS) if outputs is None else outputs
    inputs, positions, offsets, log_scales, attenuation = constants
    heads = [HeadWeights(*map(pointer, weights[i : i + 4])) for i in (0, 4, 8)]
    return DecodeArguments(
        *offsets.shape[:2],
        inputs.shape[1],
        len(weights[0]),
        *heads,
        *map(pointer, (inputs, positions, offsets, log_scales, attenuation, raw, slot_start, slots, *outputs)),
    )
