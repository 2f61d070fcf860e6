"""How rough the surfaces are that a drawing shows: what few views leave open, flat surfaces answer best.

The inverse distance of a plane is linear in the direction of view, 1 / r = n . d / h, so its second difference along
any great circle is that of a cosine: some (pixel angle)^2 of itself, however near, steep or far the plane is. What
bends more is an edge, and then colours mostly bend there too, or a surface that only the training views hold together.
"""

from __future__ import annotations

import torch
from torch import Tensor

from padgs.render import Rendering
from padgs.sphere.camera import Camera, Panorama
from padgs.sphere.distortion import solid_angle_weight

EDGES = 10.0  # per unit of the colours' mean second difference, by which a place counts less: e^-1 at 0.1
JUMP = 0.1  # relative second difference from which on there is an edge, which nothing pulls at


def roughness(rendering: Rendering, camera: Camera, *, near: float) -> Tensor:
    """Mean over neighbours across and down of |second difference of 1 / r| / (1 / r), a scalar.

    Differentiable by `rendering.depth` alone. Pixels count by their solid angle, by the opacity along all three rays,
    and less where colours bend. Where the image is no panorama all weigh alike, and left and right do not meet.

    Args:
        rendering: of [H, W] pixels, in any unit of length.
        camera: that it was drawn for.
        near: no distance is taken to be less, in the same unit.
    """
    image, depth = rendering.image.detach(), rendering.depth
    opacity = 1 - rendering.transmittance.detach()
    shown = torch.cat((image, opacity[..., None], 1 / depth.clamp(min=near)[..., None]), dim=-1)
    rows, around = depth.new_ones(len(depth)), shown
    if isinstance(camera, Panorama):
        rows = solid_angle_weight(len(depth), dtype=depth.dtype, device=depth.device)
        around = torch.cat((shown[:, -1:], shown, shown[:, :1]), dim=1)
    return _mean(_bends(shown, 0), rows[1:-1]) + _mean(_bends(around, 1), rows)


def _bends(shown: Tensor, axis: int) -> Tensor:
    """Of all pixels but the first and last along an axis: how much 1 / r bends there, times what it counts."""
    before, here, after = (shown.narrow(axis, first, shown.shape[axis] - 2) for first in range(3))
    colours = (before + after - 2 * here)[..., :3].abs().mean(-1)
    counts = before[..., 3] * here[..., 3] * after[..., 3] * torch.exp(-EDGES * colours)
    return counts * ((before[..., 4] + after[..., 4]) / here[..., 4] - 2).abs().clamp(max=JUMP)


def _mean(values: Tensor, rows: Tensor) -> Tensor:
    """Of [H, W] values whose rows weigh so much [H]."""
    return (values.mean(1) * rows).sum() / rows.sum()
