"""Smoothness prior of padgs_plus: surfaces that the training views leave open become flat.

The inverse distance of a plane is linear in the direction of view, 1 / r = n . d / h, so its second difference along a
great circle is that of a cosine: (pixel angle)^2 of itself, however near, steep or far the plane is. Larger second
differences are edges, where brightness mostly bends too, or surfaces that fit the training views alone.

On the CPU one native call computes value and derivative (csrc/cpu/roughness.cpp); `define_roughness` is the definition.
"""

import ctypes
import math
from dataclasses import replace

import torch
from torch import Tensor

from padgs.geometry.camera import Camera, Panorama
from padgs.geometry.distortion import solid_angle_weight
from padgs.native import cpu
from padgs.native.abi import RoughnessArguments, pointer
from padgs.render import Rendering
from padgs.training.loss import WithDerivative

EDGE_DECAY = 10.0  # weight exp(-EDGE_DECAY x second difference of the brightness): e^-1 at 0.1
MAX_BEND = 0.1  # relative second difference beyond which there is an edge, without gradient
MIN_SIDE = 3  # pixels that second differences take


def roughness(rendering: Rendering, camera: Camera, *, near: float, far: float = math.inf) -> Tensor:
    """Return the mean of |second difference of 1 / r| / (1 / r) across and down, a scalar.

    Differentiable by `rendering.depth` only. Pixels are weighted by solid angle, by the opacity along all three rays,
    and less where the brightness bends; for cameras other than panoramas they weigh the same and rows do not wrap.
    `near` > 0 is the lower limit of distances, in the unit of the depth. Beyond the distance `far`, the opacity counts
    times far / r: no view resolves the surface of the sky. Images of fewer than `MIN_SIDE` pixels a side have 0.
    """
    if min(rendering.depth.shape) < MIN_SIDE:
        return rendering.depth.new_zeros(())
    depth, wraps = rendering.depth, isinstance(camera, Panorama)
    if far < math.inf:
        resolved = (far / depth.detach().clamp(min=near)).clamp(max=1)
        rendering = replace(rendering, transmittance=1 - resolved * (1 - rendering.transmittance.detach()))
    rows = depth.new_ones(len(depth))
    if wraps:
        rows = solid_angle_weight(len(depth), dtype=depth.dtype, device=depth.device)
    if fits_native(rendering):
        height, width = depth.shape
        parts = (rendering.image, rendering.transmittance, depth, rows)
        inputs = [part.detach().contiguous() for part in parts]

        def evaluate(gradient: Tensor | None) -> Tensor:
            tensors = map(pointer, (*inputs, cpu.workspace("padgs_roughness_workspace", height, width), gradient))
            arguments = RoughnessArguments(width, height, wraps, near, EDGE_DECAY, MAX_BEND, *tensors)
            return inputs[0].new_tensor(cpu.library().padgs_roughness(ctypes.byref(arguments)))

        return WithDerivative.apply(depth, evaluate)
    return define_roughness(rendering, rows, wraps=wraps, near=near)


def define_roughness(rendering: Rendering, rows: Tensor, *, wraps: bool, near: float) -> Tensor:
    """Compute `roughness` in torch; `rows` [H] are the weights of rows, `wraps` whether rows are closed."""
    grey, opacity = rendering.image.detach().mean(-1), 1 - rendering.transmittance.detach()
    inverse = 1 / rendering.depth.clamp(min=near)
    down = _weighted_bends(grey, opacity, inverse, 0)
    if wraps:
        grey, opacity, inverse = (torch.cat((v[:, -1:], v, v[:, :1]), dim=1) for v in (grey, opacity, inverse))
    return _row_mean(down, rows[1:-1]) + _row_mean(_weighted_bends(grey, opacity, inverse, 1), rows)


def _weighted_bends(grey: Tensor, opacity: Tensor, inverse: Tensor, axis: int) -> Tensor:
    """Return weighted relative second differences of 1 / r along an axis, without the first and last pixel."""
    before, here, after = _neighbours(opacity, axis)
    weights = before * here * after
    before, here, after = _neighbours(grey, axis)
    weights *= torch.exp(-EDGE_DECAY * (before + after - 2 * here).abs())
    before, here, after = _neighbours(inverse, axis)
    return weights * ((before + after) / here - 2).abs().clamp(max=MAX_BEND)


def _neighbours(values: Tensor, axis: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the values before, at and after each inner position along an axis."""
    before, here, after = (values.narrow(axis, first, values.shape[axis] - 2) for first in range(3))
    return before, here, after


def _row_mean(values: Tensor, rows: Tensor) -> Tensor:
    """Return the mean of values [H, W] with row weights [H]."""
    return (values.mean(1) * rows).sum() / rows.sum()


def fits_native(rendering: Rendering) -> bool:
    """Return whether the native call takes a rendering: float32 on the CPU, at least 3x3 pixels, library built."""
    shape, parts = rendering.depth.shape, (rendering.depth, rendering.transmittance, rendering.image)
    plain = all(part.device.type == "cpu" and part.dtype == torch.float32 for part in parts)
    alike = rendering.transmittance.shape == shape and rendering.image.shape == (*shape, 3)
    return plain and alike and min(shape) >= MIN_SIDE and cpu.available()
