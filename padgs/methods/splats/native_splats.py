"""Native evaluation of `Splats` for one camera, with derivatives: one call each way on a CPU or a GPU.

`padgs.methods.splats.splats.Splats` is the definition; csrc/cpu/splats.cpp and csrc/cuda/splats.cu compute the same.
"""

import ctypes
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from padgs.geometry.harmonics import MAX_DEGREE
from padgs.native import cpu, cuda, library_for
from padgs.native.abi import SplatArguments, pointer

MAX_COEFFICIENTS = (MAX_DEGREE + 1) ** 2 - 1  # of degrees >= 1, per colour channel
Call = Callable[..., None]  # calls a library with sizes, centre, tiny and tensors as `SplatArguments` has them


class Parameters(NamedTuple):
    """Learned parameters of N Gaussians without their quaternions, and the offsets of their means."""

    means: Tensor  # [N, 3] world
    log_scales: Tensor  # [N, 3] of world units
    opacity_logits: Tensor  # [N]
    dc: Tensor  # [N, 3] coefficients of degree 0
    rest: Tensor  # [N, K, 3] coefficients of degrees >= 1
    mean_offsets: Tensor | None  # [N, 3] or [N, 4], see `Splats.displaced`


class Evaluated(NamedTuple):
    """Attributes of N Gaussians as one camera sees them."""

    means: Tensor  # [N, 3] world, with the offsets
    scales: Tensor  # [N, 3] world units
    opacities: Tensor  # [N]
    colors: Tensor  # [N, 3]
    absolute_offsets: Tensor | None  # [N] if the offsets are [N, 4]


def native_call(means: Tensor, center: Tensor) -> Call | None:
    """Return the library's call for float32 tensors of a device; None if torch must do it, as cameras learn."""
    if center.requires_grad or (library := library_for(means)) is None:
        return None
    return call_cuda if library is cuda else call_cpu


def call_cpu(sizes: tuple, center: Tensor, tiny: float, *tensors: Tensor | None) -> None:
    """Call the CPU library."""
    arguments = SplatArguments(*sizes, (ctypes.c_float * 3)(*center.tolist()), tiny, *map(pointer, tensors))
    cpu.library().padgs_splats(ctypes.byref(arguments))


def call_cuda(sizes: tuple, center: Tensor, tiny: float, *tensors: Tensor | None) -> None:
    """Call the GPU library; the centre stays on the GPU."""
    arguments = SplatArguments(*sizes, (ctypes.c_float * 3)(), tiny, *map(pointer, tensors))
    cuda.call("padgs_cuda_splats", cuda.queue(center.device), cuda.DeviceSplatArguments(arguments, pointer(center)))


def native_splats(parameters: Parameters, degree: int, center: Tensor, tiny: float, call: Call = call_cpu) -> Evaluated:
    """Evaluate Gaussians of an SH degree for a camera at `center` [3], differentiably; `tiny` is added to distances."""
    return Evaluated(*_Splats.apply(call, degree, center.contiguous(), tiny, *parameters))


class _Splats(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, call: Call, degree: int, center: Tensor, tiny: float, *inputs: Any):
        parameters, offsets = [tensor.contiguous() for tensor in inputs[:-1]], inputs[-1]
        means, log_scales, opacity_logits, dc, rest = parameters
        offsets = None if offsets is None else offsets.contiguous()
        width = 0 if offsets is None else offsets.shape[1]
        assert (degree + 1) ** 2 - 1 <= rest.shape[1] <= MAX_COEFFICIENTS, "the library gets bare pointers"
        like = (means, log_scales, opacity_logits, dc, opacity_logits if width > 3 else None)
        outputs = tuple(map(_empty_like, like))
        ctx.call = functools.partial(call, (len(means), degree, rest.shape[1], width), center, tiny)
        ctx.save_for_backward(*parameters, offsets, *outputs)
        ctx.call(*parameters, offsets, *outputs)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None):
        saved = ctx.saved_tensors
        contiguous = (None if gradient is None else gradient.contiguous() for gradient in upstream)
        gradients = tuple(map(_empty_like, saved[: len(Parameters._fields)]))
        ctx.call(*saved, *contiguous, *gradients)
        return None, None, None, None, *gradients


def _empty_like(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else torch.empty_like(tensor)
