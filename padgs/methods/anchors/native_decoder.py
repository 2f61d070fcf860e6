"""Native decoding of anchors into Gaussians, with derivatives; `padgs.methods.anchors.decoder` is the definition.

CPU: one call each way (csrc/cpu/decode.cpp). GPU: matrix products by torch, one for the hidden layers of the three
networks, the rest by csrc/cuda/decode.cu. All tensors are float32.
"""

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from padgs.native import cpu, cuda
from padgs.native.abi import DecodeArguments, DecodeGradientArguments, HeadWeights, pointer
from padgs.native.cuda import DeviceDecodeArguments, DeviceDecodeGradientArguments

OPACITY_VALUES, COLOR_VALUES, COVARIANCE_VALUES = 1, 3, 7  # outputs of each network per Gaussian
SIZES = (3, 4, 3, 0, 3)  # values per Gaussian of means, quats, scales, opacities, colors; 0 = a scalar
ALIGNMENT = 8  # rows of inputs are padded with zeros to a multiple: cuBLAS is slower for unaligned rows
CHUNK = 512  # anchors in one part of a product that sums over anchors


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


# From the fields of `SeenAnchors` and the networks' twelve tensors, differentiably: means, quaternions, scales,
# opacities, colours, slots and raw opacities of the selected Gaussians.
decode_on_cpu = _DecodeOnCPU.apply


def decode_arguments(
    constants: Sequence[Tensor],
    raw: Tensor,
    starts: Tensor,
    slots: Tensor | None,
    outputs: Sequence[Tensor | None],
    inputs: Tensor | None = None,
    weights: Sequence[Tensor] = (),
) -> DecodeArguments:
    """Fill the structure of a library; the GPU takes no inputs and weights, because torch evaluates the networks."""
    heads = [HeadWeights(*map(pointer, weights[first : first + 4])) for first in (0, 4, 8)]
    hidden, width = weights[0].shape if weights else (0, 0)
    buffers = (inputs, *constants, raw, starts, slots, *outputs)
    return DecodeArguments(*raw.shape, width, hidden, *heads, *map(pointer, buffers))


class _DecodeOnGPU(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, capacity, features, seen, positions, offsets, log_scales, attenuation, *weights):
        padding = -(features.shape[1] + seen.shape[1]) % ALIGNMENT
        inputs = torch.cat((features.detach(), seen, seen.new_zeros(len(seen), padding)), dim=-1)
        constants = [t.detach().contiguous() for t in (positions, offsets, log_scales, attenuation)]
        weights = [w.detach() for w in weights]
        w1, b1 = functional.pad(torch.cat(weights[0::4]), (0, padding)), torch.cat(weights[1::4])
        hidden = torch.ops.aten._addmm_activation(b1, inputs, w1.T)  # ReLU is its default
        parts = hidden.split(len(weights[0]), dim=1)
        opacity, color, covariance = (
            torch.addmm(b2, part, w2.T) for part, w2, b2 in zip(parts, weights[2::4], weights[3::4], strict=True)
        )
        raw = opacity.tanh_()
        starts = torch.zeros(len(raw) + 1, dtype=torch.int64, device=raw.device)
        torch.cumsum((raw > 0).sum(-1), 0, out=starts[1:])
        rows = int(starts[-1]) if capacity is None else capacity
        slots, outputs = starts.new_empty(rows), [raw.new_empty((rows, size) if size else rows) for size in SIZES]
        arguments = DeviceDecodeArguments(
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
            *map(pointer, (None, grad_offsets, grad_log_scales, None)),
        )
        arguments = DeviceDecodeGradientArguments(gradient, len(slots), *map(pointer, grad_logits))
        cuda.call("padgs_cuda_decode_take_back", cuda.queue(raw.device), arguments)

        units, grad_hidden = len(weights[0]), torch.empty_like(hidden)
        for part, grad, w2 in zip(grad_hidden.split(units, 1), grad_logits, weights[2::4], strict=True):
            torch.mm(grad, w2, out=part)
        grad_hidden.masked_fill_(hidden <= 0, 0)
        of_w1 = summed_products(grad_hidden, inputs)[:, : weights[0].shape[1]].split(units)
        of_b1 = grad_hidden.sum(0).split(units)
        of_w2 = [summed_products(grad, part) for grad, part in zip(grad_logits, hidden.split(units, 1), strict=True)]
        of_b2 = [grad.sum(0) for grad in grad_logits]
        of_weights = [grad for head in zip(of_w1, of_b1, of_w2, of_b2, strict=True) for grad in head]
        grad_features = grad_hidden @ w1[:, : ctx.features]
        return None, grad_features, None, None, grad_offsets, grad_log_scales, None, *of_weights


# As on the CPU, after a capacity, and with the number of selected Gaussians, [1] int64. The result has `capacity` rows:
# the selected Gaussians up to it, then zeros with slots of others; None: as many as are selected, which the host reads.
decode_on_gpu = _DecodeOnGPU.apply


def summed_products(left: Tensor, right: Tensor) -> Tensor:
    """Return left^T right of [A, M] and [A, N], by chunks of rows: so small a result would keep few SMs busy."""
    parts = len(left) // CHUNK
    whole = parts * CHUNK
    first, second = (rows[:whole].view(parts, CHUNK, rows.shape[1]) for rows in (left, right))
    return torch.bmm(first.transpose(1, 2), second).sum(0) + left[whole:].T @ right[whole:]
