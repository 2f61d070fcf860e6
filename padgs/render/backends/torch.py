"""The readable rasterizer, and the definition of what all others must compute. float32 or float64, any device.

Pixels are processed in blocks, and blocks are computed again for the backward pass, so that memory stays bounded: a
block holds (pixels x N) squared distances.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from padgs.geometry.camera import Camera
from padgs.render.absolute import with_absolute_pull
from padgs.render.contract import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, Rendering, RenderOptions, Request
from padgs.render.hybrid import hybrid_weights
from padgs.render.projection import Footprints, project
from padgs.render.published_bounds import check_memory, instances

PAIRS_PER_BLOCK = 1 << 21  # (pixel, Gaussian) pairs held at once


def rasterize(request: Request) -> Rendering:
    """Render by brute force: every pixel against every visible Gaussian."""
    gaussians, camera, options, background = request.gaussians, request.camera, request.options, request.background
    footprints = project(request)
    order = torch.argsort(footprints.depths.detach(), stable=True)
    order = order[footprints.visible[order]]
    if options.memory_cap is not None and footprints.boxes is not None:
        check_memory(instances(footprints.boxes[order], camera.width, camera.height), options)
    parts = []
    places = blocks(camera, len(order), background.device)
    for rows, columns in places:
        arguments = (footprints, gaussians.colors, background, order, rows, columns, options, request.absolute_probe)
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
    """Rows and columns of all pixels, in blocks small enough to hold each against `count` Gaussians."""
    pixels = torch.arange(camera.height * camera.width, device=device)
    size = max(1, PAIRS_PER_BLOCK // max(1, count))
    return [(torch.div(some, camera.width, rounding_mode="floor"), some % camera.width) for some in pixels.split(size)]


def _blend(
    footprints: Footprints,
    colors: Tensor,
    background: Tensor,
    order: Tensor,
    rows: Tensor,
    columns: Tensor,
    options: RenderOptions,
    absolute_probe: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Colour [P, 3], transmittance [P] and depth [P] of some pixels, and how many pairs contribute (Eq. 4)."""
    alpha = fragments(footprints, order, rows, columns, absolute_probe)
    if options.blending == "hybrid":
        weights, transmittance = hybrid_weights(alpha, footprints.distance(order, rows, columns), options.core_size)
    else:
        weights, transmittance = sorted_weights(alpha)
    color = weights @ colors[order] + transmittance[:, None] * background
    coverage = weights.sum(-1)
    covered = coverage > 0
    depth = (weights @ footprints.depths[order]) / torch.where(covered, coverage, torch.ones_like(coverage))
    return color, transmittance, depth, int((weights.detach() > 0).sum())


def fragments(
    footprints: Footprints, order: Tensor, rows: Tensor, columns: Tensor, absolute_probe: Tensor | None = None
) -> Tensor:
    """Alpha [P, K] of K Gaussians in some order at some pixels; 0 where nothing is drawn."""
    q, inside = footprints.squared_distance(order, rows, columns)  # [P, K] each
    if absolute_probe is not None:
        q = with_absolute_pull(q, footprints.slope(order, rows, columns), absolute_probe[order])
    alpha = (footprints.opacities[order] * torch.exp(-0.5 * q)).clamp(max=ALPHA_MAX)
    return torch.where(inside & (alpha.detach() >= ALPHA_MIN), alpha, torch.zeros_like(alpha))


def sorted_weights(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Weights [P, K] of fragments [P, K] that are in order, and what is left [P]."""
    running = torch.cumprod(1 - alpha.detach(), dim=-1) >= TRANSMITTANCE_MIN
    alpha = torch.where(running, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, dim=-1)
    after = torch.cat((alpha.new_ones(len(alpha), 1), after), dim=-1)  # transmittance before each and behind the last
    return alpha * after[:, :-1], after[:, -1]
