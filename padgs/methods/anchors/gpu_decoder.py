"""Decoding anchors into Gaussians on a GPU: matrix products by torch, all around them by csrc/cuda/decode.cu.

`padgs.methods.anchors.decoder` is the definition. Reduced precisions go to `padgs.methods.anchors.fused_decoder` where it takes
them. The hidden layers of the three networks are one product, with the ReLU in it; their values are kept for the way
back, 4 bytes for each of the 96 units of an anchor (2 in a reduced precision). TF32 in the products is torch's own
switch.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from padgs.methods.anchors import fused_decoder
from padgs.methods.anchors.cpu_decoder import COLOR_VALUES, COVARIANCE_VALUES, OPACITY_VALUES, SIZES, decode_arguments
from padgs.methods.anchors.precision import OF_GRADIENTS
from padgs.native import cuda
from padgs.native.abi import DecodeGradientArguments, pointer

ALIGNED = 8  # numbers; zeros fill up rows of inputs, for cuBLAS has only slower kernels where rows are not aligned
PART = 4096  # anchors of one part of a product that sums over them


def decode_on_gpu(
    weights: tuple[Tensor, ...], *tensors: Tensor, dtype: torch.dtype | None = None, room: int | None = None
) -> tuple[Tensor, ...]:
    """`padgs.methods.anchors.cpu_decoder.decode_on_cpu` where the GPU's library keeps its tensors.

    Args:
        weights, tensors: as there.
        dtype: of the products; None: float32.
        room: rows of the result, at most A K. The selected Gaussians come first, as far as there is room; rows behind
            them are zeros, and have the slots of others that are not selected. None: as many as are selected, for which
            the host waits.

    Returns:
        What is returned there, and how many Gaussians are selected, [1] int64.
    """
    features, offsets = tensors[0], tensors[3]
    if dtype is not None and fused_decoder.fits(weights, features, offsets):
        return fused_decoder.decode_fused(weights, *tensors, dtype=dtype, room=room)
    return _DecodeOnGPU.apply(dtype, room, *tensors, *weights)


class _DecodeOnGPU(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, dtype, room, features, seen, positions, offsets, log_scales, attenuation, *weights):
        dtype = dtype or features.dtype
        padding = -(features.shape[1] + seen.shape[1]) % ALIGNED
        inputs = torch.cat((features.detach(), seen, seen.new_zeros(len(seen), padding)), dim=-1).to(dtype)
        constants = [t.detach().contiguous() for t in (positions, offsets, log_scales, attenuation)]
        weights = [w.detach() for w in weights]
        w1, b1 = functional.pad(torch.cat(weights[0::4]), (0, padding)).to(dtype), torch.cat(weights[1::4]).to(dtype)
        hidden = torch.ops.aten._addmm_activation(b1, inputs, w1.T)  # ReLU is its default
        parts = hidden.split(len(weights[0]), dim=1)
        opacity, color, covariance = (
            torch.addmm(b2.to(dtype), part, w2.to(dtype).T).float()
            for part, w2, b2 in zip(parts, weights[2::4], weights[3::4], strict=True)
        )
        raw = opacity.tanh_()
        starts = torch.zeros(len(raw) + 1, dtype=torch.int64, device=raw.device)
        torch.cumsum((raw > 0).sum(-1), 0, out=starts[1:])
        slots, outputs = fused_decoder.rows_for(starts, raw, room)
        arguments = cuda.DeviceDecodeArguments(
            decode_arguments(constants, raw, starts, slots, outputs), len(slots), pointer(color), pointer(covariance)
        )
        cuda.call("padgs_cuda_decode_place", cuda.queue(raw.device), arguments)
        ctx.save_for_backward(inputs, w1, hidden, *weights, *constants, raw, starts, slots, *outputs)
        ctx.features = features.shape[1]
        count = starts[-1:]
        ctx.mark_non_differentiable(slots, raw, count)
        return *outputs, slots, raw, count

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor):
        inputs, w1, hidden, *saved = ctx.saved_tensors
        weights, constants, (raw, starts, slots), outputs = saved[:12], saved[12:16], saved[16:19], saved[19:]
        upstream = [grad.contiguous() for grad in grads[: len(SIZES)]]
        offsets, log_scales = constants[1:3]
        grad_offsets, grad_log_scales = torch.empty_like(offsets), torch.empty_like(log_scales)
        anchors, per_anchor = raw.shape
        values = (OPACITY_VALUES, COLOR_VALUES, COVARIANCE_VALUES)
        grad_logits = [raw.new_empty(anchors, value * per_anchor) for value in values]
        gradient = DecodeGradientArguments(
            decode_arguments(constants, raw, starts, slots, outputs),
            *map(pointer, upstream),
            ctx.features,
            None,
            pointer(grad_offsets),
            pointer(grad_log_scales),
            None,
        )
        arguments = cuda.DeviceDecodeGradientArguments(gradient, len(slots), *map(pointer, grad_logits))
        cuda.call("padgs_cuda_decode_take_back", cuda.queue(raw.device), arguments)

        dtype = raw.dtype if inputs.dtype == raw.dtype else OF_GRADIENTS  # of the products
        inputs, w1, units = inputs.to(dtype), w1.to(dtype), len(weights[0])
        parts, logits = hidden.to(dtype).split(units, 1), [grad.to(dtype) for grad in grad_logits]
        grad_hidden = torch.empty_like(hidden, dtype=dtype)
        for part, grad, w2 in zip(grad_hidden.split(units, 1), logits, weights[2::4], strict=True):
            torch.mm(grad, w2.to(dtype), out=part)
        grad_hidden.masked_fill_(hidden <= 0, 0)
        of_w1 = summed_products(grad_hidden, inputs)[:, : weights[0].shape[1]].split(units)
        of_b1 = grad_hidden.sum(0, dtype=raw.dtype).split(units)
        of_w2 = [summed_products(grad, part) for grad, part in zip(logits, parts, strict=True)]
        of_b2 = [grad.sum(0) for grad in grad_logits]
        of_weights = [grad.to(raw.dtype) for head in zip(of_w1, of_b1, of_w2, of_b2, strict=True) for grad in head]
        grad_features = (grad_hidden @ w1[:, : ctx.features]).to(raw.dtype)
        return None, None, grad_features, None, None, grad_offsets, grad_log_scales, None, *of_weights


def summed_products(left: Tensor, right: Tensor) -> Tensor:
    """left^T right of [A, M] and [A, N], by parts of the A rows, or so small a result would keep few SMs busy."""
    parts = len(left) // PART
    whole = parts * PART
    first, second = (rows[:whole].view(parts, PART, rows.shape[1]) for rows in (left, right))
    return torch.bmm(first.transpose(1, 2), second).sum(0) + left[whole:].T @ right[whole:]
