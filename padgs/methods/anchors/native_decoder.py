"""Native decoding of anchors into Gaussians, with derivatives; `padgs.methods.anchors.decoder` is the definition.

CPU: one call each way (csrc/cpu/decode.cpp). GPU, float32: matrix products by torch, one for the hidden layers of the
three networks, the rest by csrc/cuda/decode.cu. GPU, reduced precision: products on tensor cores inside the kernels
that use them (csrc/cuda/networks*.cu), which compute hidden units again in the backward pass.
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
from padgs.native.cuda import DeviceDecodeArguments, DeviceDecodeGradientArguments, NetworkInputs

OPACITY_VALUES, COLOR_VALUES, COVARIANCE_VALUES = 1, 3, 7  # outputs of each network per Gaussian
SIZES = (3, 4, 3, 0, 3)  # values per Gaussian of means, quats, scales, opacities, colors; 0 = a scalar
ALIGNMENT = 8  # rows of inputs are padded with zeros to a multiple: cuBLAS is slower for unaligned rows
CHUNK = 4096  # anchors in one part of a product that sums over anchors
REDUCED_TYPES = {torch.bfloat16: 0, torch.float16: 1}  # as `ReducedType` of csrc/cuda/arguments.h
# In a reduced precision parameters and results stay float32; operands are rounded for a product, which is summed in
# float32 and rounded once. torch on a GPU may round partial sums too (torch.backends.cuda.matmul), the kernels do not.
# Products of gradients are always in bfloat16: gradients of a mean over pixels are too small for float16.
PRECISIONS = ("float32", "bfloat16", "float16")
GRADIENT_TYPE = torch.bfloat16


def reduced_dtype(precision: str) -> torch.dtype | None:
    """Return the type of a precision; None for float32, the tensors' own type."""
    if precision not in PRECISIONS:
        raise ValueError(f"unknown precision {precision!r}; known: {', '.join(PRECISIONS)}")
    return None if precision == "float32" else getattr(torch, precision)


def linear(inputs: Tensor, weight: Tensor, bias: Tensor, dtype: torch.dtype | None) -> Tensor:
    """Apply a layer of weight [O, I] and bias [O] to inputs [A, I] with a product in `dtype`, None: their type."""
    if dtype is None:
        return torch.addmm(bias, inputs, weight.T)
    return _ReducedLinear.apply(inputs, weight, bias, dtype)


class _ReducedLinear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor, dtype: torch.dtype) -> Tensor:
        ctx.save_for_backward(inputs, weight)
        return torch.addmm(bias.to(dtype), inputs.to(dtype), weight.to(dtype).T).to(inputs.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor):
        inputs, weight = (tensor.to(GRADIENT_TYPE) for tensor in ctx.saved_tensors)
        rounded = grad.to(GRADIENT_TYPE)
        return (rounded @ weight).to(grad.dtype), (rounded.T @ inputs).to(grad.dtype), grad.sum(0), None


def decode_on_cpu(weights: tuple[Tensor, ...], *tensors: Tensor) -> tuple[Tensor, ...]:
    """Return means, quaternions, scales, opacities, colours, slots and raw opacities of the selected Gaussians.

    `weights` are the twelve tensors of the networks, `tensors` the fields of `SeenAnchors`. Differentiable by weights,
    features, offsets and log-scales.
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
    """Fill the structure of a library; the GPU takes no inputs, and no weights if torch evaluates the networks."""
    heads = [HeadWeights(*map(pointer, weights[first : first + 4])) for first in (0, 4, 8)]
    hidden, width = weights[0].shape if weights else (0, 0)
    buffers = (inputs, *constants, raw, starts, slots, *outputs)
    return DecodeArguments(*raw.shape, width, hidden, *heads, *map(pointer, buffers))


def decode_on_gpu(
    weights: tuple[Tensor, ...], *tensors: Tensor, dtype: torch.dtype | None = None, capacity: int | None = None
) -> tuple[Tensor, ...]:
    """Return `decode_on_cpu` and the number of selected Gaussians, [1] int64, with products in `dtype`.

    The result has `capacity` rows: the selected Gaussians up to it, then zeros with slots of Gaussians that are not
    selected. None: as many rows as are selected, a number that the host waits for.
    """
    if dtype is not None:
        features, offsets, (hidden, inputs) = tensors[0], tensors[3], weights[0].shape
        sizes = features.shape[1], inputs, hidden, offsets.shape[1]
        if cuda.library().padgs_cuda_networks_fit(ctypes.byref(cuda.queue(features.device)), *sizes):
            return _DecodeOnTensorCores.apply(REDUCED_TYPES[dtype], capacity, *tensors, *weights)
    return _DecodeOnGPU.apply(dtype, capacity, *tensors, *weights)


class _DecodeOnGPU(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, dtype, capacity, features, seen, positions, offsets, log_scales, attenuation, *weights):
        dtype = dtype or features.dtype
        padding = -(features.shape[1] + seen.shape[1]) % ALIGNMENT
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
        slots, outputs = empty_rows(starts, raw, capacity)
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
            None,
            pointer(grad_offsets),
            pointer(grad_log_scales),
            None,
        )
        arguments = DeviceDecodeGradientArguments(gradient, len(slots), *map(pointer, grad_logits))
        cuda.call("padgs_cuda_decode_take_back", cuda.queue(raw.device), arguments)

        dtype = raw.dtype if inputs.dtype == raw.dtype else GRADIENT_TYPE  # of the products
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
    """Return left^T right of [A, M] and [A, N], by chunks of rows: so small a result would keep few SMs busy."""
    parts = len(left) // CHUNK
    whole = parts * CHUNK
    first, second = (rows[:whole].view(parts, CHUNK, rows.shape[1]) for rows in (left, right))
    return torch.bmm(first.transpose(1, 2), second).sum(0) + left[whole:].T @ right[whole:]


class _DecodeOnTensorCores(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, reduced_type, capacity, features, seen, positions, offsets, log_scales, attenuation, *weights
    ):
        _check_tensors((features, seen, *weights, positions, offsets, log_scales, attenuation))
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
        slots, outputs = empty_rows(starts, raw, capacity)
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


def _check_tensors(tensors: Sequence[Tensor]) -> None:
    """Refuse tensors that the kernels would misread."""
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


def empty_rows(starts: Tensor, raw: Tensor, capacity: int | None) -> tuple[Tensor, list[Tensor]]:
    """Return uninitialised slots and Gaussians for a capacity; None: for all selected ones (waits for the GPU)."""
    rows = int(starts[-1]) if capacity is None else capacity
    return starts.new_empty(rows), [raw.new_empty((rows, size) if size else rows) for size in SIZES]


def _network_inputs(inputs: Sequence[Tensor], reduced_type: int) -> NetworkInputs:
    return NetworkInputs(*map(pointer, inputs), inputs[0].shape[1], reduced_type)
