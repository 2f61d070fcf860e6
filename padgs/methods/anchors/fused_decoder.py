"""Decoding anchors on a GPU's tensor cores: a reduced precision's products within the kernels that use them.

csrc/cuda/networks.cu and networks_backward.cu; `padgs.methods.anchors.precision` says what is rounded. Going back, hidden units
are computed once more, and the gradients of features and weights leave as float32 sums of rounded factors (those of the
biases of outputs, too) that are not rounded again.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from padgs.methods.anchors.cpu_decoder import SIZES, decode_arguments
from padgs.native import cuda
from padgs.native.abi import DecodeGradientArguments, pointer
from padgs.native.cuda import DeviceDecodeArguments, DeviceDecodeGradientArguments, NetworkInputs

TYPES = {torch.bfloat16: 0, torch.float16: 1}  # as `ReducedType` of csrc/cuda/arguments.h


def fits(weights: Sequence[Tensor], features: Tensor, offsets: Tensor) -> bool:
    """Whether the kernels take networks of this size, and this GPU has the tensor cores for them.

    Args:
        weights: the twelve tensors of the networks.
        features: [A, C].
        offsets: [A, K, 3].
    """
    hidden, inputs = weights[0].shape
    queue = cuda.queue(features.device)
    sizes = features.shape[1], inputs, hidden, offsets.shape[1]
    return bool(cuda.library().padgs_cuda_networks_fit(ctypes.byref(queue), *sizes))


def decode_fused(
    weights: tuple[Tensor, ...], *tensors: Tensor, dtype: torch.dtype, room: int | None
) -> tuple[Tensor, ...]:
    """`padgs.methods.anchors.gpu_decoder.decode_on_gpu` where `fits`; products are taken in `dtype`, one of `TYPES`."""
    return _DecodeFused.apply(TYPES[dtype], room, *tensors, *weights)


class _DecodeFused(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, reduced_type, room, features, seen, positions, offsets, log_scales, attenuation, *weights):
        _refuse_others((features, seen, *weights, positions, offsets, log_scales, attenuation))
        inputs = [t.detach().contiguous() for t in (features, seen)]
        constants = [t.detach().contiguous() for t in (positions, offsets, log_scales, attenuation)]
        weights = [w.detach().contiguous() for w in weights]
        anchors, per_anchor = offsets.shape[:2]
        raw = features.new_empty(anchors, per_anchor)
        starts = torch.zeros(anchors + 1, dtype=torch.int64, device=raw.device)
        read, queue = _network_inputs(inputs, reduced_type), cuda.queue(raw.device)
        nowhere = decode_arguments(constants, raw, starts, None, [None] * len(SIZES), weights=weights)
        arguments = cuda.NetworkArguments(DeviceDecodeArguments(nowhere, 0, None, None), read)
        cuda.call("padgs_cuda_networks_opacity", queue, arguments)
        starts.cumsum_(0)
        slots, outputs = rows_for(starts, raw, room)
        placed = decode_arguments(constants, raw, starts, slots, outputs, weights=weights)
        arguments = cuda.NetworkArguments(DeviceDecodeArguments(placed, len(slots), None, None), read)
        cuda.call("padgs_cuda_networks_attributes", queue, arguments)
        ctx.save_for_backward(*inputs, *weights, *constants, raw, starts, slots, *outputs)
        ctx.reduced_type = reduced_type
        count = starts[-1:]
        ctx.mark_non_differentiable(slots, raw, count)
        return *outputs, slots, raw, count

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor):
        saved = ctx.saved_tensors
        inputs, weights, constants, (raw, starts, slots) = saved[:2], saved[2:14], saved[14:18], saved[18:21]
        upstream = [grad.contiguous() for grad in grads[: len(SIZES)]]
        grad_features, grad_offsets, grad_log_scales = map(torch.empty_like, (inputs[0], *constants[1:3]))
        sizes, queue = [w.numel() for w in weights], cuda.queue(raw.device)
        blocks = cuda.library().padgs_cuda_networks_blocks(len(raw))
        grad_weights = raw.new_empty(blocks, sum(sizes))
        gradient = DecodeGradientArguments(
            decode_arguments(constants, raw, starts, slots, saved[21:], weights=weights),
            *map(pointer, upstream),
            inputs[0].shape[1],
            *map(pointer, (grad_features, grad_offsets, grad_log_scales, grad_weights)),
        )
        arguments = DeviceDecodeGradientArguments(gradient, len(slots), None, None, None)
        cuda.call("padgs_cuda_decode_take_back", queue, arguments)
        arguments = cuda.NetworkGradientArguments(gradient, _network_inputs(inputs, ctx.reduced_type), len(slots))
        cuda.call("padgs_cuda_networks_backward", queue, arguments)
        of_weights = grad_weights.sum(0).split(sizes)
        shaped = (part.view_as(weight) for part, weight in zip(of_weights, weights, strict=True))
        return None, None, grad_features, None, None, grad_offsets, grad_log_scales, None, *shaped


def _refuse_others(tensors: Sequence[Tensor]) -> None:
    """Kernels take what pointers point at for what it should be."""
    features, seen, first, *_ = tensors
    if features.shape[1] + seen.shape[1] != first.shape[1]:
        raise ValueError(
            f"networks of {first.shape[1]} inputs do not fit {features.shape[1]} features and {seen.shape[1]} numbers "
            "of how an anchor is seen; use_distortion must be as the networks were made for"
        )
    for tensor in tensors:
        if tensor.dtype != torch.float32 or tensor.device != features.device:
            raise ValueError(
                f"a tensor of the decoder is {tensor.dtype} on {tensor.device}; all must be float32 on "
                f"{features.device}, and are rounded where they are multiplied (method.precision)"
            )


def rows_for(starts: Tensor, raw: Tensor, room: int | None) -> tuple[Tensor, list[Tensor]]:
    """Empty slots and Gaussians, as many as there is room for; None: as many as are selected, for which it waits."""
    rows = int(starts[-1]) if room is None else room
    return starts.new_empty(rows), [raw.new_empty((rows, size) if size else rows) for size in SIZES]


def _network_inputs(inputs: Sequence[Tensor], reduced_type: int) -> NetworkInputs:
    return NetworkInputs(*map(pointer, inputs), inputs[0].shape[1], reduced_type)
