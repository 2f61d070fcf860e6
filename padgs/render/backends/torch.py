"""The readable rasterizer, which defines what all backends compute. float32 or float64, any device.

Pixels are processed in blocks, and blocks are computed again in the backward pass, so that memory stays bounded: a
block holds (pixels x N) squared distances.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.utils.checkpoint import checkpoint

from padgs.geometry.camera import Camera
from padgs.render import contract
from padgs.render.contract import Rendering, Request
from padgs.render.projection import Footprints, project

PAIRS_PER_BLOCK = 1 << 21  # (pixel, Gaussian) pairs held at once


def rasterize(request: Request) -> Rendering:
    """Render by brute force: every pixel against every visible Gaussian."""
    gaussians, camera = request.gaussians, request.camera
    footprints = project(request)
    order = torch.argsort(footprints.depths.detach(), stable=True)
    order = order[footprints.visible[order]]
    parts = []
    places = blocks(camera, len(order), gaussians.means.device)
    for rows, columns in places:
        arguments = (footprints, request, order, rows, columns)
        if len(places) > 1 and torch.is_grad_enabled():
            parts.append(checkpoint(_blend, *arguments, use_reentrant=False, preserve_rng_state=False))
        else:
            parts.append(_blend(*arguments))
    colors, transmittances, depths, contributing = zip(*parts, strict=True)
    counters = {
        "gaussians": len(gaussians),
        "visible": len(order),
        "evaluated": camera.height * camera.width * len(order),
        "contributing": sum(contributing),
    }
    size = (camera.height, camera.width)
    return Rendering(
        torch.cat(colors).view(*size, 3),
        torch.cat(transmittances).view(size),
        torch.cat(depths).view(size),
        footprints.visible,
        counters,
    )


def blocks(camera: Camera, count: int, device: torch.device | str = "cpu") -> list[tuple[Tensor, Tensor]]:
    """Return rows and columns of all pixels, in blocks small enough to hold each against `count` Gaussians."""
    pixels = torch.arange(camera.height * camera.width, device=device)
    size = max(1, PAIRS_PER_BLOCK // max(1, count))
    return [(torch.div(some, camera.width, rounding_mode="floor"), some % camera.width) for some in pixels.split(size)]


def _blend(
    footprints: Footprints, request: Request, order: Tensor, rows: Tensor, columns: Tensor
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Return colour [P, 3], transmittance [P], depth [P] and the number of contributing pairs of P pixels (Eq. 4)."""
    options, alpha = request.options, fragments(footprints, order, rows, columns, request.absgrad)
    if options.blending == "hybrid":
        weights, transmittance = hybrid_weights(alpha, footprints.distance(order, rows, columns), options.core_size)
    else:
        weights, transmittance = sorted_weights(alpha)
    color = weights @ request.gaussians.colors[order] + transmittance[:, None] * request.background
    coverage = weights.sum(-1)
    covered = coverage > 0
    depth = (weights @ footprints.depths[order]) / torch.where(covered, coverage, torch.ones_like(coverage))
    return color, transmittance, depth, int((weights.detach() > 0).sum())


def fragments(
    footprints: Footprints, order: Tensor, rows: Tensor, columns: Tensor, absgrad: Tensor | None = None
) -> Tensor:
    """Return alpha [P, K] of K Gaussians in a given order at P pixels; 0 where nothing is drawn."""
    q, inside = footprints.squared_distance(order, rows, columns)  # [P, K] each
    if absgrad is not None:
        q = WithAbsgrad.apply(q, footprints.slope(order, rows, columns), absgrad[order])
    alpha = (footprints.opacities[order] * torch.exp(-0.5 * q)).clamp(max=contract.ALPHA_MAX)
    return torch.where(inside & (alpha.detach() >= contract.ALPHA_MIN), alpha, torch.zeros_like(alpha))


def sorted_weights(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weights [P, K] of fragments sorted front to back, and the transmittance [P]."""
    running = torch.cumprod(1 - alpha.detach(), dim=-1) >= contract.TRANSMITTANCE_MIN
    alpha = torch.where(running, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, dim=-1)
    after = torch.cat((alpha.new_ones(len(alpha), 1), after), dim=-1)  # transmittance before each and behind the last
    return alpha * after[:, :-1], after[:, -1]


def hybrid_weights(alpha: Tensor, distance: Tensor, core_size: int) -> tuple[Tensor, Tensor]:
    """Return the weights [P, K] and transmittance [P] of fragments under hybrid transparency (SPaGS).

    `alpha` [P, K] is of every pixel and Gaussian, 0 where nothing is drawn, `distance` [P, K] along the ray, without
    gradient; the first in the list wins ties. Weights and transmittance sum to 1, or to within 1e-4 where the core
    ended early. The core is the `core_size` nearest fragments with alpha >= 0.05, blended front to back until less than
    1e-4 is left, which then counts as 0. All others are the tail. With T the transmittance of the core, Z and Q the sum
    of alpha and the product of 1 - alpha over the tail, the tail lies behind the core as one layer of opacity 1 - Q
    with the mean colour weighted by alpha: a tail fragment has the weight T (1 - Q) alpha / Z. The choice of the core
    is a constant to autograd. Fragments are sorted along the ray of the pixel, so that nothing pops when the order of
    the means changes; the price is a tail without order.
    """
    solid = alpha.detach() >= contract.CORE_ALPHA_MIN
    key = torch.where(solid, distance, torch.full_like(distance, torch.inf))
    nearest = torch.argsort(key, dim=-1, stable=True)[:, :core_size]
    in_core = torch.zeros_like(solid).scatter(1, nearest, solid.gather(1, nearest))
    none = torch.zeros_like(alpha)

    core = torch.where(in_core, alpha, none).gather(1, nearest)  # front to back
    after = torch.cumprod(1 - core, dim=-1)
    after = torch.where(after.detach() >= contract.TRANSMITTANCE_MIN, after, torch.zeros_like(after))
    after = torch.cat((alpha.new_ones(len(alpha), 1), after), dim=-1)  # before each and behind the last
    core_weights = none.scatter(1, nearest, core * after[:, :-1])
    through = after[:, -1]

    tail = torch.where(in_core, none, alpha)
    left = torch.prod(1 - tail, dim=-1)
    total = tail.sum(-1)  # 0, or at least 1/255 as every fragment is
    share = through * (1 - left) / torch.where(total > 0, total, torch.ones_like(total))
    return core_weights + tail * share[:, None], through * left


class WithAbsgrad(torch.autograd.Function):
    """Return q; the backward pass sets the gradient of `absgrad` to the absolute positional gradient.

    The gradient of a mean is a sum over pixels, in which opposite gradients of a Gaussian that should be split cancel.
    The absolute one is the sum of norms, sum over pixels p of |dL/dq_p| |dq_p/dmean|, of the slopes [P, K] per world
    unit. AbsGS and Gaussian Opacity Fields sum absolute values of each image coordinate instead; norms do not depend on
    the axes.
    """

    @staticmethod
    def forward(ctx: Any, q: Tensor, slope: Tensor, _absgrad: Tensor) -> Tensor:
        """Return q."""
        ctx.save_for_backward(slope)
        return q.view_as(q)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_q: Tensor):
        """Return the gradients of q and absgrad."""
        (slope,) = ctx.saved_tensors
        return grad_q, None, (grad_q.abs() * slope).sum(0)
