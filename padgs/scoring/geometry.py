"""How well a rendering knows where things are, and whether it is the same whichever way the camera faces.

Depths are distances from the camera, [H, W] in world units; the truth is infinite in the sky, where nothing is
measured. All means are over the sphere: each row weighs as much as its solid angle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from padgs.render import Rendering
from padgs.scene import View
from padgs.sphere.distortion import solid_angle_weight

WITHIN = 1.25  # a depth is right if it is off by less than this factor
IN_FRONT = 0.05  # share of the distance by which a floater hangs before the surface


def depth_error(depth: Tensor, truth: Tensor) -> Tensor:
    """Absolute relative error, the mean of |depth - truth| / truth (AbsRel).

    >>> depth_error(torch.full((2, 4), 3.0), torch.full((2, 4), 2.0)).item()
    0.5
    """
    return _mean((depth - truth).abs() / truth, truth)


def depth_within(depth: Tensor, truth: Tensor) -> Tensor:
    """Share of directions whose depth is off by less than a factor of `WITHIN` (delta < 1.25)."""
    ratio = torch.maximum(depth / truth, truth / depth.clamp(min=1e-30))
    return _mean((ratio < WITHIN).to(depth), truth)


def floaters(depth: Tensor, alpha: Tensor, truth: Tensor) -> Tensor:
    """Share of directions in which matter hangs in front of the surface: the mean depth is more than `IN_FRONT` short
    of it, each direction counting with its alpha.

    Thin mist moves a mean depth little and is not seen.
    """
    return _mean(alpha * (depth < (1 - IN_FRONT) * truth), truth)


def yaw_error(render: Callable[[View], Rendering], view: View, image: Tensor) -> Tensor:
    """Largest difference of a panorama from the one that a camera draws that looks back, turned back by whole pixels.

    0 for a renderer to which the seam is a place like any other.

    Args:
        render: of the method.
        view: a panorama of even width.
        image: what `render` shows of it, [H, W, 3].
    """
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=view.cam_from_world.dtype))
    back = render(replace(view, cam_from_world=turn.to(view.cam_from_world) @ view.cam_from_world)).image
    return (back.roll(view.width // 2, dims=1) - image).abs().max()


def of_view(render: Callable[[View], Rendering], view: View, rendering: Rendering) -> dict[str, float | None]:
    """All of these numbers of a rendering; None where there is nothing to compare with."""
    marks: dict[str, float | None] = {"yaw_error": None, "depth_error": None, "depth_within": None, "floaters": None}
    if view.lens is None and view.width % 2 == 0:
        marks["yaw_error"] = yaw_error(render, view, rendering.image).item()
    if view.load_depth is not None:
        depth, truth = rendering.depth, view.load_depth().to(rendering.depth)
        marks["depth_error"] = _known(depth_error(depth, truth))
        marks["depth_within"] = _known(depth_within(depth, truth))
        marks["floaters"] = _known(floaters(depth, 1 - rendering.transmittance, truth))
    return marks


def _mean(values: Tensor, truth: Tensor) -> Tensor:
    """Mean over the directions whose true depth is finite; NaN if there are none."""
    rows = solid_angle_weight(len(truth), dtype=values.dtype, device=values.device)[:, None]
    weight = rows * torch.isfinite(truth)
    return (torch.where(weight > 0, values, 0) * weight).sum() / weight.sum()


def _known(mean: Tensor) -> float | None:
    value = mean.item()
    return None if math.isnan(value) else value
