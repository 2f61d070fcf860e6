"""How well a rendering knows where things are, and whether it is the same whichever way the camera faces.

Depths are distances from the camera, [H, W] in world units; the truth is infinite in the sky, where nothing is
measured. All means are over the sphere: each row weighs as much as its solid angle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from padgs.evaluation.evaluate import known
from padgs.geometry.distortion import solid_angle_weight
from padgs.geometry.panorama import rays
from padgs.render import Rendering
from padgs.scene import View

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


def least_extent(depth: Tensor, truth: Tensor) -> Tensor:
    """How thick the surfaces that a view shows are all together, as a share of the true ones: the ratio of the smallest
    standard deviations along any axis. Near 0 where all has collapsed onto a plane, or into a point; NaN if there are
    none.
    """
    if not torch.isfinite(truth).any():
        return truth.new_tensor(torch.nan)
    thinnest = []
    directions = rays(depth.shape[1], depth.shape[0]).to(depth)
    for distances in (depth, truth):
        points = torch.where(torch.isfinite(truth)[..., None], distances[..., None] * directions, 0.0)
        mean = torch.stack([_mean(points[..., axis], truth) for axis in range(3)])
        off = points - mean
        spread = torch.stack([_mean(off[..., i] * off[..., j], truth) for i in range(3) for j in range(3)])
        thinnest.append(torch.linalg.eigvalsh(spread.reshape(3, 3).double())[0].clamp(min=0).sqrt())
    return thinnest[0] / thinnest[1]


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
    names = ("yaw_error", "depth_error", "depth_within", "floaters", "least_extent")
    marks: dict[str, float | None] = dict.fromkeys(names)
    if view.lens is None and view.width % 2 == 0:
        marks["yaw_error"] = yaw_error(render, view, rendering.image).item()
    if view.load_depth is not None:
        depth, truth = rendering.depth, view.load_depth().to(rendering.depth)
        marks["depth_error"] = known(depth_error(depth, truth))
        marks["depth_within"] = known(depth_within(depth, truth))
        marks["floaters"] = known(floaters(depth, 1 - rendering.transmittance, truth))
        marks["least_extent"] = known(least_extent(depth, truth)) if view.lens is None else None
    return marks


def _mean(values: Tensor, truth: Tensor) -> Tensor:
    """Mean over the directions whose true depth is finite; NaN if there are none."""
    rows = solid_angle_weight(len(truth), dtype=values.dtype, device=values.device)[:, None]
    weight = rows * torch.isfinite(truth)
    return (torch.where(weight > 0, values, 0) * weight).sum() / weight.sum()
