"""How rough the surfaces are that a drawing shows: what few views leave open, flat surfaces answer best.

The inverse distance of a plane is linear in the direction of view, 1 / r = n . d / h, so its second difference along
any great circle is that of a cosine: some (pixel angle)^2 of itself, however near, steep or far the plane is. What
bends more is an edge, and then the brightness mostly bends there too, or a surface that fits the training views alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from padgs.geometry.camera import Camera, Panorama
from padgs.geometry.distortion import solid_angle_weight
from padgs.methods.plus.cpu_roughness import fits, native_roughness
from padgs.render import Rendering

EDGES = 10.0  # per unit of the brightness's second difference, by which a place counts less: e^-1 at 0.1
JUMP = 0.1  # relative second difference from which on there is an edge, which nothing pulls at


def roughness(rendering: Rendering, camera: Camera, *, near: float) -> Tensor:
    """Mean over neighbours across and down of |second difference of 1 / r| / (1 / r), a scalar.

    Differentiable by `rendering.depth` alone. Pixels count by their solid angle, by the opacity along all three rays,
    and less where the brightness bends. Where the image is no panorama all weigh alike, and left and right do not meet.

    Args:
        rendering: of [H, W] pixels, in any unit of length.
        camera: that it was drawn for.
        near: > 0, no distance is taken to be less, in the same unit.
    """
    depth, around = rendering.depth, isinstance(camera, Panorama)
    rows = depth.new_ones(len(depth))
    if around:
        rows = solid_angle_weight(len(depth), dtype=depth.dtype, device=depth.device)
    if fits(rendering):
        return native_roughness(rendering, rows, around=around, near=near, edges=EDGES, jump=JUMP)
    grey, opacity = rendering.image.detach().mean(-1), 1 - rendering.transmittance.detach()
    inverse = 1 / depth.clamp(min=near)
    down = _bends(grey, opacity, inverse, 0)
    if around:
        grey, opacity, inverse = (torch.cat((v[:, -1:], v, v[:, :1]), dim=1) for v in (grey, opacity, inverse))
    return _mean(down, rows[1:-1]) + _mean(_bends(grey, opacity, inverse, 1), rows)


def _bends(grey: Tensor, opacity: Tensor, inverse: Tensor, axis: int) -> Tensor:
    """Of all pixels but the first and last along an axis: how much 1 / r bends there, times what it counts."""
    before, here, after = _neighbours(opacity, axis)
    counts = before * here * after
    before, here, after = _neighbours(grey, axis)
    counts *= torch.exp(-EDGES * (before + after - 2 * here).abs())
    before, here, after = _neighbours(inverse, axis)
    return counts * ((before + after) / here - 2).abs().clamp(max=JUMP)


def _neighbours(values: Tensor, axis: int) -> tuple[Tensor, Tensor, Tensor]:
    """All values but the first and last along an axis, in the middle of those before and after each."""
    before, here, after = (values.narrow(axis, first, values.shape[axis] - 2) for first in range(3))
    return before, here, after


def _mean(values: Tensor, rows: Tensor) -> Tensor:
    """Of [H, W] values whose rows weigh so much [H]."""
    return (values.mean(1) * rows).sum() / rows.sum()
