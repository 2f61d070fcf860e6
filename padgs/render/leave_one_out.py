"""What an image would lose with each of its Gaussians alone: exactly, from one pass like the backward of blending.

Removing a Gaussian changes a pixel by dC = alpha / (1 - alpha) B - w c: its own colour c with the weight w = alpha T is
gone, and what lies behind it, blended to B with the background, shines through. With the residual r = image - target
the squared error changes by ||dC||^2 + 2 <r, dC>. That is no estimate, but where a pixel stops, because less than 1e-4
of the light would be left: then others may stop it instead.

What others prune by (opacity, size, contribution, curvature of the loss) says how much a Gaussian shows; this says what
its absence costs. A negative change is a Gaussian that does harm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.registry import lookup
from padgs.render import request_of, resolve_backend
from padgs.render.backends.torch import blocks, fragments, sorted_weights
from padgs.render.contract import CORE_SIZE, Removals, RenderOptions, Request
from padgs.render.projection import project
from padgs.scene import View

Backend = Callable[[Request, Tensor, Tensor], Removals]  # target [H, W, 3], weight [H, W] of each squared error
BACKENDS = {
    "torch": "padgs.render.leave_one_out:define",
    "cpu": "padgs.render.backends.cpu:leave_one_out",
    "cuda": "padgs.render.backends.cuda:leave_one_out",
}


@torch.no_grad()
def leave_one_out(
    gaussians: Gaussians,
    view: View,
    target: Tensor,
    weight: Tensor,
    options: RenderOptions = RenderOptions(),  # noqa: B008 - frozen dataclass
    *,
    backend: str = "auto",
) -> Removals:
    """Score N Gaussians by one view, drawn before black.

    Hybrid blending, where who is in order depends on
    who is there, is scored as if it were sorted, and a cubemap as the panorama that its faces make, by rays; these
    changes are estimates.

    Args:
        gaussians: N Gaussians.
        view: pose and image size.
        target: [H, W, 3], what it should look like.
        weight: [H, W] or [H, 1] of the pixels, >= 0 and not 0 everywhere; only ratios matter.
        options: how it is drawn.
        backend: torch, cpu, cuda, or auto, as for `padgs.render.render`; what is on a GPU without a library for it is
            scored on the CPU.

    Raises:
        ValueError: unknown backend, a target of another size than the view, or inputs that break the contract.
    """
    device, resolved = gaussians.means.device, resolve_backend(backend, gaussians.means)
    if backend == "auto" and resolved == "torch" and device.type != "cpu":
        found = leave_one_out(gaussians.to("cpu"), view, target.cpu(), weight.cpu(), options)
        return Removals(*(tensor.to(device) for tensor in vars(found).values()))
    if options.blending == "hybrid":
        options = replace(options, blending="sorted", core_size=CORE_SIZE)
    if options.cubemap:
        options = replace(options, cubemap=False, face_size=None, projection="ray", low_pass_kind="auto")
    request = request_of(gaussians, view, options)
    if target.shape != (view.camera.height, view.camera.width, 3):
        raise ValueError(
            f"the target has {list(target.shape)} numbers, but a view of {view.camera.width}x{view.camera.height} has "
            f"[{view.camera.height}, {view.camera.width}, 3]; give it in the size of the view"
        )
    target = target.to(gaussians.means)
    weight = weight.to(target).expand(target.shape[:2])
    weight = (weight / weight.double().sum()).to(target).contiguous()
    score: Backend = lookup(BACKENDS, resolved, "backend")
    found = score(request, target.contiguous(), weight)
    return replace(found, error=found.error / 3, change=found.change / 3)  # means over channels


def define(request: Request, target: Tensor, weight: Tensor) -> Removals:
    """The readable one, and the definition of what others must compute: every pixel against every visible Gaussian."""
    gaussians, camera, background = request.gaussians, request.camera, request.background
    footprints = project(request)
    order = torch.argsort(footprints.depths, stable=True)
    order = order[footprints.visible[order]]
    colors = gaussians.colors[order]
    device = gaussians.means.device
    error, squares, contribution = torch.zeros(3, len(gaussians), dtype=torch.float64, device=device)
    peak = gaussians.means.new_zeros(len(gaussians))
    for rows, columns in blocks(camera, len(order), device):
        alpha = fragments(footprints, order, rows, columns)
        shown, left = sorted_weights(alpha)  # [P, K], [P]
        parts = shown[..., None] * colors  # [P, K, 3]
        image = parts.sum(1) + left[:, None] * background
        behind = image[:, None] - parts.cumsum(1)  # each Gaussian and all in front of it taken away
        change = (alpha / (1 - alpha))[..., None] * behind - parts
        change = torch.where((shown > 0)[..., None], change, 0)
        residual = (image - target[rows, columns])[:, None]
        weights = weight[rows, columns, None].double()  # [P, 1]
        error[order] += (weights * (change * (change + 2 * residual)).sum(-1)).sum(0)
        squares[order] += (weights * change.square().sum(-1)).sum(0)
        contribution[order] += (weights * shown).sum(0)
        if len(rows):
            peak[order] = torch.maximum(peak[order], shown.amax(0))
    return Removals(error, squares, contribution, peak)
