"""Diagnostics of the stability protocol: depth errors, floaters, dependence on yaw, and the pole gap.

Depths are distances from the camera, [H, W] in world units; true depths of 0 (unknown) or infinity (sky) are not
measured. All means are over the sphere: each row has the weight of its solid angle.

The pole gap is the WS-PSNR of rows within 30 degrees of the horizon minus that of rows beyond 75 degrees, in dB. If the
scene has more detail at the horizon, it is negative for a method that treats all directions equally. It is therefore
compared with the gap of an oracle: the ground truth, blurred equally in all directions to the WS-PSNR of the render.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import product

import torch
from torch import Tensor

from padgs.evaluation.evaluate import finite_or_none
from padgs.evaluation.metrics import band_ws_psnr, ws_psnr
from padgs.geometry.distortion import solid_angle_weight
from padgs.geometry.panorama import direction, longitude_latitude, rays, row_latitudes
from padgs.render import Rendering
from padgs.scene import View

WITHIN = 1.25  # largest factor between a correct depth and the true one
IN_FRONT = 0.05  # distance of a floater in front of the surface, as a share of the depth
RINGS, CORNERS = 8, 4  # samples of a blur; corners are evenly spaced, so that nothing shifts
SHARPEST = 0.05  # standard deviation of the finest blur in pixels of the horizon
COARSEST = 1.0  # radian; nearly a single colour
HALVINGS = 10  # bisection steps of the logarithm of the blur: to less than a percent
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))  # from ring to ring


def depth_scores(view: View, rendering: Rendering, mask: Tensor | None = None) -> dict[str, float | None]:
    """Return AbsRel and delta < 1.25 of the depth of a panorama, by solid angle; None without measured depth."""
    if view.load_depth is None or view.depth_is_relative or view.lens is not None:
        return {"abs_rel": None, "delta_1_25": None}
    depth, truth = rendering.depth, view.load_depth().to(rendering.depth)
    if mask is not None:
        truth = torch.where(mask > 0, truth, 0)
    found = {"abs_rel": depth_error(depth, truth), "delta_1_25": depth_within(depth, truth)}
    return {name: finite_or_none(value) for name, value in found.items()}


def depth_error(depth: Tensor, truth: Tensor) -> Tensor:
    """Return the absolute relative error, the mean of |depth - truth| / truth (AbsRel).

    >>> depth_error(torch.full((2, 4), 3.0), torch.full((2, 4), 2.0)).item()
    0.5
    """
    return _mean((depth - truth).abs() / truth, truth)


def depth_within(depth: Tensor, truth: Tensor) -> Tensor:
    """Return the share of directions whose depth is within a factor of `WITHIN` of the true one (delta < 1.25)."""
    ratio = torch.maximum(depth / truth, truth / depth.clamp(min=1e-30))
    return _mean((ratio < WITHIN).to(depth), truth)


def floaters(depth: Tensor, alpha: Tensor, truth: Tensor) -> Tensor:
    """Return the share of directions, weighted by alpha, whose mean depth is in front of the surface by `IN_FRONT`.

    Thin mist changes a mean depth little and is not detected.
    """
    return _mean(alpha * (depth < (1 - IN_FRONT) * truth), truth)


def least_extent(depth: Tensor, truth: Tensor) -> Tensor:
    """Return the smallest standard deviation of the rendered points along any axis, relative to the true points.

    Near 0 if the model has collapsed to a plane or a point; NaN if no true depth is known and finite.
    """
    if not (torch.isfinite(truth) & (truth > 0)).any():
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
    """Return the largest difference between a panorama and one rendered after a yaw of 180 degrees, rolled back.

    0 for a renderer without artefacts at the seam. The panorama has an even width; the image [H, W, 3] is its render.
    """
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=view.cam_from_world.dtype))
    back = render(replace(view, cam_from_world=turn.to(view.cam_from_world) @ view.cam_from_world)).image
    return (back.roll(view.width // 2, dims=1) - image).abs().max()


def diagnose(
    render: Callable[[View], Rendering], view: View, rendering: Rendering, mask: Tensor | None = None
) -> dict[str, float | None]:
    """Return yaw and depth diagnostics of a panorama; None without measured depth, for yaw at an odd width.

    Depth counts where the mask [H, W] is above 0.
    """
    names = ("yaw_error", "depth_error", "depth_within", "floaters", "least_extent")
    metrics: dict[str, float | None] = dict.fromkeys(names)
    if view.width % 2 == 0:
        metrics["yaw_error"] = yaw_error(render, view, rendering.image).item()
    if view.load_depth is not None and not view.depth_is_relative:
        depth, truth = rendering.depth, view.load_depth().to(rendering.depth)
        truth = truth if mask is None else torch.where(mask > 0, truth, 0.0)
        metrics["depth_error"], metrics["depth_within"] = depth_scores(view, rendering, mask).values()
        metrics["floaters"] = finite_or_none(floaters(depth, 1 - rendering.transmittance, truth))
        metrics["least_extent"] = finite_or_none(least_extent(depth, truth))
    return metrics


def _mean(values: Tensor, truth: Tensor) -> Tensor:
    """Return the mean over directions with known, finite true depth; NaN if there are none."""
    rows = solid_angle_weight(len(truth), dtype=values.dtype, device=values.device)[:, None]
    weight = rows * (torch.isfinite(truth) & (truth > 0))
    return (torch.where(weight > 0, values, 0) * weight).sum() / weight.sum()


def pole_gap(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the WS-PSNR of the equator minus that of the poles, in dB; NaN if either has no weighted pixel."""
    equator, poles = (band_ws_psnr(image, target, mask, band=band) for band in ("equator", "pole"))
    return equator - poles


def oracle(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor | None:
    """Return the target [H, W, 3] blurred to the WS-PSNR of the image, by bisection; None if no blur has it."""
    wanted = ws_psnr(image, target, mask)
    low, high = (math.log(sigma) for sigma in (SHARPEST * 2 * math.pi / target.shape[1], COARSEST))
    finest, coarsest = (ws_psnr(blurred(target, math.exp(end)), target, mask) for end in (low, high))
    if not coarsest <= wanted <= finest:
        return None
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        if ws_psnr(blurred(target, math.exp(middle)), target, mask) > wanted:
            low = middle
        else:
            high = middle
    return blurred(target, math.exp((low + high) / 2))


def blurred(image: Tensor, sigma: float) -> Tensor:
    """Blur a panorama [H, W, C] with a Gaussian of standard deviation `sigma` in radian, equally in all directions.

    Averages samples on rings around each direction, with radii at quantiles of the Gaussian. The samples of all columns
    of a row have the same offsets, so a shift along a row is a phase of its spectrum; between rows it is linear.
    """
    height, width = image.shape[:2]
    spectrum = torch.fft.rfft(image, dim=1)
    orders = torch.arange(spectrum.shape[1], device=image.device)
    beyond = (1 - 2 * (orders % 2)).to(image.dtype)[:, None]  # half a turn, as in `pad_panorama`
    spectrum = torch.cat((beyond * spectrum[:1], spectrum, beyond * spectrum[-1:]))
    latitudes = row_latitudes(height, dtype=image.dtype, device=image.device)
    ahead = direction(torch.zeros_like(latitudes), latitudes)
    down = direction(torch.zeros_like(latitudes), latitudes + math.pi / 2)
    east = torch.tensor((1.0, 0.0, 0.0)).to(image)
    total = torch.zeros_like(spectrum[:height])
    for ring, corner in product(range(RINGS), range(CORNERS)):
        radius = sigma * math.sqrt(-2 * math.log1p(-(ring + 0.5) / RINGS))
        angle = ring * GOLDEN_ANGLE + corner * 2 * math.pi / CORNERS
        aside = math.cos(angle) * east + math.sin(angle) * down
        longitude, latitude = longitude_latitude(math.cos(radius) * ahead + math.sin(radius) * aside)
        place = (latitude / math.pi + 0.5) * height + 0.5  # in rows of `spectrum`
        row = place.long()
        between = (place - row)[:, None, None].to(spectrum.dtype)
        turned = torch.polar(torch.ones_like(longitude)[:, None], longitude[:, None] * orders)[..., None]
        total += turned * spectrum[row].lerp(spectrum[row + 1], between)
    return torch.fft.irfft(total / (RINGS * CORNERS), n=width, dim=1)
