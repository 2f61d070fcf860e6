"""The readable rasterizer, and the definition of what all others must compute. float32 or float64, any device.

Pixels are processed in chunks of rows so that memory stays bounded: a chunk holds (rows x W x N) squared distances, and
the backward pass computes them again instead of keeping those of all chunks.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from padgs.gaussians import Gaussians
from padgs.render.contract import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, Rendering, RenderOptions
from padgs.render.projection import Footprints, project

PAIRS_PER_CHUNK = 1 << 22  # (pixel, Gaussian) pairs held at once


def rasterize(
    gaussians: Gaussians,
    cam_from_world: Tensor,
    width: int,
    height: int,
    options: RenderOptions,
    background: Tensor,
    probe: Tensor | None = None,
) -> Rendering:
    """Render by brute force: every pixel against every Gaussian whose bounds touch its row.

    Arguments are those of `padgs.render.render`, checked, with the pose as a [4, 4] tensor in the dtype of the means.
    """
    footprints = project(gaussians, cam_from_world, width, height, options, probe)
    order = torch.argsort(footprints.sort_key.detach(), stable=True)
    order = order[footprints.visible[order]]
    rows_per_chunk = max(1, PAIRS_PER_CHUNK // max(1, width * len(order)))
    counters = {"gaussians": len(gaussians), "visible": len(order), "evaluated": 0, "contributing": 0}
    images, transmittances, depths = [], [], []
    for first_row in range(0, height, rows_per_chunk):
        rows = (first_row, min(height, first_row + rows_per_chunk))
        nearest_first = order[footprints.touches_rows(order, *rows)]
        arguments = (footprints, gaussians.colors, background, nearest_first, *rows)
        if rows_per_chunk < height and torch.is_grad_enabled():
            blended = checkpoint(_blend_rows, *arguments, use_reentrant=False, preserve_rng_state=False)
        else:
            blended = _blend_rows(*arguments)
        image, transmittance, depth, contributing = blended
        images.append(image)
        transmittances.append(transmittance)
        depths.append(depth)
        counters["evaluated"] += transmittance.numel() * len(nearest_first)
        counters["contributing"] += contributing
    return Rendering(torch.cat(images), torch.cat(transmittances), torch.cat(depths), footprints.visible, counters)


def _blend_rows(
    footprints: Footprints, colors: Tensor, background: Tensor, nearest_first: Tensor, first_row: int, last_row: int
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Image [rows, W, 3], transmittance and depth [rows, W] of some rows, and how many pairs contribute to them."""
    q, inside = footprints.squared_distance(nearest_first, first_row, last_row)  # [rows, W, K] each
    alpha = (footprints.opacities[nearest_first] * torch.exp(-0.5 * q)).clamp(max=ALPHA_MAX)
    accepted = inside & (alpha >= ALPHA_MIN)
    alpha = torch.where(accepted, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, dim=-1)  # transmittance after each Gaussian if nothing stopped
    running = after.detach() >= TRANSMITTANCE_MIN
    alpha = torch.where(running, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, dim=-1)
    before = torch.cat((torch.ones_like(after[..., :1]), after[..., :-1]), dim=-1)
    weights = alpha * before  # [rows, W, K]
    transmittance = after[..., -1] if len(nearest_first) else background.new_ones(q.shape[:2])
    image = weights @ colors[nearest_first] + transmittance[..., None] * background
    coverage = weights.sum(-1)
    empty = coverage == 0
    depth = (weights @ footprints.depths[nearest_first]) / torch.where(empty, torch.ones_like(coverage), coverage)
    return image, transmittance, depth, int((weights.detach() > 0).sum())
