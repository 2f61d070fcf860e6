"""Leave-one-out scores: the change of the error of one image when a single Gaussian is removed, for all in one pass.

Removing a Gaussian changes a pixel by dC = alpha / (1 - alpha) B - w c: its colour c with the weight w = alpha T goes,
and B, the blend of everything behind it with the background, shows through. With the residual r = image - target the
squared error changes by ||dC||^2 + 2 <r, dC>. This is exact, except where a pixel stops because less than 1e-4 of the
transmittance would be left: another Gaussian may then stop it instead. A negative score is a Gaussian that increases
the error.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from padgs.checks import lookup
from padgs.gaussians import Gaussians
from padgs.render import make_request, resolve_backend
from padgs.render.backends.torch import blocks, fragments, sorted_weights
from padgs.render.contract import CORE_SIZE, Removals, RenderOptions, Request
from padgs.render.projection import project
from padgs.render.ray_blocks import is_in_blocks, score_blocks
from padgs.scene import View

Backend = Callable[[Request, Tensor, Tensor], Removals]  # target [H, W, 3], weight [H, W] of each squared error
BACKENDS = {
    "torch": "padgs.render.leave_one_out:score",
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
    """Score N Gaussians by one view with a black background.

    Hybrid blending is scored as if it were sorted, a cubemap as a panorama by rays, and several samples a pixel as one;
    these scores are estimates.

    `target` [H, W, 3] is the ground truth; only ratios of the pixels' weights [H, W] or [H, 1] >= 0 matter. With
    backend auto, tensors of a GPU are scored on the CPU if the library for it is missing. Raises ValueError as
    `padgs.render.render` does, for a target of another size than the view, and for weights of another or without sum.
    """
    device, resolved = gaussians.means.device, resolve_backend(backend, gaussians.means)
    if backend == "auto" and resolved == "torch" and device.type != "cpu":
        found = leave_one_out(gaussians.to("cpu"), view, target.cpu(), weight.cpu(), options)
        return Removals(*(tensor.to(device) for tensor in vars(found).values()))
    options = replace(options, supersampling=1)
    if options.blending == "hybrid":
        options = replace(options, blending="sorted", core_size=CORE_SIZE)
    if options.cubemap:
        options = replace(options, cubemap=False, projection="ray", low_pass_kind="auto", bounds="exact", wrap=True)
    request = make_request(gaussians, view, options)
    if target.shape != (view.camera.height, view.camera.width, 3):
        raise ValueError(
            f"the target has shape {list(target.shape)}, but the view is {view.camera.width}x{view.camera.height}; "
            f"it must be [{view.camera.height}, {view.camera.width}, 3]"
        )
    target, weight = target.to(gaussians.means), weight.to(gaussians.means)
    if weight.shape not in (target.shape[:2], (len(target), 1)) or not weight.sum() > 0:
        raise ValueError(
            f"weights have shape {list(weight.shape)} and sum {weight.sum().item():g}; they must be [H, W] or [H, 1] "
            f"for a target of {list(target.shape)}, with a sum above 0"
        )
    weight = weight.expand(target.shape[:2])
    weight = (weight / weight.double().sum()).to(target).contiguous()
    backend_score: Backend = lookup(BACKENDS, resolved, "backend")
    if resolved != "torch" and is_in_blocks(view.camera):
        found = score_blocks(backend_score, request, target, weight)
    else:
        found = backend_score(request, target.contiguous(), weight)
    return replace(found, error=found.error / 3, change=found.change / 3)  # means over channels


def score(request: Request, target: Tensor, weight: Tensor) -> Removals:
    """Score by brute force, every pixel against every visible Gaussian: the definition of what backends compute."""
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
        behind = image[:, None] - parts.cumsum(1)  # without each Gaussian and all in front of it
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
