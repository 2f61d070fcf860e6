"""Splats as a view sees them, and the derivatives by what is learned, in one native call each (csrc/cpu/splats.cpp).

`padgs.methods.splats.model.Splats` has the definition; `padgs.methods.splats.gpu_splats` fills the same structure.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from padgs.geometry.harmonics import MAX_DEGREE
from padgs.native import cpu
from padgs.native.abi import SplatArguments, pointer

MOST_STORED = (MAX_DEGREE + 1) ** 2 - 1
PROBES = (3, 4)  # widths; with 4 absolute pulls are wanted, too


class Learned(NamedTuple):
    """What is learned of N Gaussians, but for their quaternions, and the probe that moves them."""

    means: Tensor  # [N, 3] world
    log_scales: Tensor  # [N, 3] of world units
    opacity_logits: Tensor  # [N]
    dc: Tensor  # [N, 3] coefficients of degree 0
    rest: Tensor  # [N, K, 3] of the degrees from 1 on
    probe: Tensor | None  # [N, 3] or [N, 4], as `Splats.probed` has it


class Seen(NamedTuple):
    """What becomes of it."""

    means: Tensor  # [N, 3] world, moved by the probe
    scales: Tensor  # [N, 3] world units
    opacities: Tensor  # [N]
    colors: Tensor  # [N, 3]
    pulls: Tensor | None  # [N] where the probe is [N, 4]


def fits(means: Tensor, center: Tensor) -> bool:
    """Whether there is a native pass for these: float32 on the CPU, a camera that does not learn, a library."""
    on_cpu = means.device.type == "cpu" and means.dtype == torch.float32
    return on_cpu and not center.requires_grad and cpu.available()


def _run(sizes: tuple, center: Tensor, tiny: float, *tensors: Tensor | None) -> None:
    arguments = SplatArguments(*sizes, (ctypes.c_float * 3)(*center.tolist()), tiny, *map(pointer, tensors))
    cpu.library().padgs_splats(ctypes.byref(arguments))


def native_splats(
    learned: Learned, degree: int, center: Tensor, tiny: float, *, run: Callable[..., None] = _run
) -> Seen:
    """The Gaussians that a camera sees, differentiable by all that is learned and by the probe.

    Args:
        learned: of the Gaussians.
        degree: of the harmonics that is in use.
        center: [3] of the camera, world.
        tiny: what is added to distances, in squares; world units.
        run: calls a library with sizes, center, tiny and tensors as `SplatArguments` has them.
    """
    return Seen(*_Splats.apply(run, degree, center, tiny, *learned))


class _Splats(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, run: Callable[..., None], degree: int, center: Tensor, tiny: float, *learned: Any):
        parameters, probe = [tensor.contiguous() for tensor in learned[:-1]], learned[-1]
        means, log_scales, opacity_logits, dc, rest = parameters
        probe = None if probe is None else probe.contiguous()
        width = 0 if probe is None else probe.shape[1]
        _refuse_others(degree, rest.shape[1], width, *parameters, *([] if probe is None else [probe]))
        like = (means, log_scales, opacity_logits, dc, opacity_logits if width > 3 else None)
        seen = tuple(map(_empty_like, like))
        ctx.run = functools.partial(run, (len(means), degree, rest.shape[1], width), center, tiny)
        ctx.save_for_backward(*parameters, probe, *seen)
        ctx.run(*parameters, probe, *seen)
        return seen

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor | None):
        saved = ctx.saved_tensors
        contiguous = (None if gradient is None else gradient.contiguous() for gradient in upstream)
        gradients = tuple(map(_empty_like, saved[: len(Learned._fields)]))
        ctx.run(*saved, *contiguous, *gradients)
        return None, None, None, None, *gradients


def _refuse_others(degree: int, stored: int, width: int, *tensors: Tensor) -> None:
    """The library takes what pointers point at for what it should be."""
    if not (degree + 1) ** 2 - 1 <= stored <= MOST_STORED:
        raise ValueError(
            f"sh_rest has {stored} coefficients, but degree {degree} in use takes {(degree + 1) ** 2 - 1} to "
            f"{MOST_STORED}; lower active_degree"
        )
    if width not in (0, *PROBES):
        raise ValueError(f"the probe is {width} wide; it must be {' or '.join(map(str, PROBES))}")
    if len({(tensor.dtype, tensor.device) for tensor in tensors}) > 1:
        kinds = ", ".join(f"{name} {t.dtype} on {t.device}" for name, t in zip(Learned._fields, tensors, strict=False))
        raise ValueError(f"Gaussians of one type and device are drawn together, not {kinds}; move them with .to()")


def _empty_like(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else torch.empty_like(tensor)
