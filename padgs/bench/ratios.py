"""The same work done in two ways, one after the other in the same run: what each of our choices is worth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from padgs.anchors.decoder import decode_gaussians, define_gaussians
from padgs.bench.tile_counts import BOUNDS
from padgs.bench.workload import OPTIONS, Workload
from padgs.clock import measure
from padgs.gaussians import Gaussians
from padgs.learning.loop import TrainOptions
from padgs.learning.loss import define_loss, photometric_loss, target_moments
from padgs.learning.targets import Target, Targets
from padgs.render import Rendering, RenderOptions, render

LAMBDA_L1 = TrainOptions().lambda_l1
PROJECTIONS = {
    "tangent": RenderOptions(projection="tangent"),
    "ray": RenderOptions(projection="ray"),
    "hybrid": RenderOptions(projection="ray", blending="hybrid"),  # SPaGS
}


def ratios(work: Workload, brute_force: Workload, repeats: int) -> dict[str, dict[str, Any]]:
    """Name -> how many times longer the slow way takes.

    Args:
        work: what everything but the torch renderer is timed on.
        brute_force: less, for the torch renderer, whose work is the product of pixels and Gaussians. On larger images
            it falls further behind.
        repeats: of each.
    """
    target = Targets(work.scene.train[:1], "solid_angle")[0]
    exact, square = BOUNDS["exact"], BOUNDS["square"]
    published = _ratio(
        "published bounds (square, no wrap)", "exact bounds", _drawing(work, square), _drawing(work, exact), repeats
    )
    counts = {name: _draw(_decoded(work), work, options).counters for name, options in BOUNDS.items()}
    for count in ("instances", "evaluated"):
        published[count] = counts["square"][count] / counts["exact"][count]
    slow_renderer = _ratio(
        "torch renderer", "native renderer", _drawing(brute_force, OPTIONS, "torch"), _drawing(brute_force, OPTIONS), 1
    )
    slow_renderer["size"] = [brute_force.size.width, brute_force.size.height, brute_force.size.gaussians]
    image = torch.rand(work.size.height, work.size.width, 3, generator=torch.Generator().manual_seed(1))
    return {
        "torch_renderer": slow_renderer,
        "published_bounds": published,
        "torch_decode": _ratio(
            "torch decoder", "native decoder", _decoding(work, define_gaussians), _decoding(work), repeats
        ),
        "torch_loss": _ratio("torch loss", "native loss", _defining(image, target), _comparing(image, target), repeats),
        "decode": _ratio(
            "decode, draw with erp", "draw with erp", _decoding_and_drawing(work), _drawing(work, OPTIONS), repeats
        ),
        **{name: _against_erp(work, options, repeats) for name, options in PROJECTIONS.items()},
    }


def _against_erp(work: Workload, options: RenderOptions, repeats: int) -> dict[str, Any]:
    """The same Gaussians under another projection, forward and backward."""
    hybrid = ", hybrid" if options.blending == "hybrid" else ""
    options = replace(options, near=OPTIONS.near)
    found = _ratio(
        f"draw with {options.projection}{hybrid}",
        "draw with erp",
        _drawing(work, options),
        _drawing(work, OPTIONS),
        repeats,
    )
    counts = [_draw(_decoded(work), work, each).counters for each in (options, OPTIONS)]
    return found | {count: counts[0][count] / counts[1][count] for count in ("instances", "evaluated")}


def render_both_ways(work: Workload, repeats: int) -> dict[str, Any]:
    """Time drawing fixed Gaussians and going back to their gradients, natively."""
    return measure(_drawing(work, OPTIONS), repeats=repeats)


def _decoded(work: Workload) -> Gaussians:
    with torch.no_grad():
        found = work.model.decode(work.view).gaussians
    leaves = (found.means, found.quats, found.scales, found.opacities, found.colors)
    return Gaussians(*(leaf.clone().requires_grad_() for leaf in leaves))


def _draw(gaussians: Gaussians, work: Workload, options: RenderOptions, backend: str = "cpu") -> Rendering:
    return render(gaussians, work.view, options, backend=backend)


def _drawing(work: Workload, options: RenderOptions, backend: str = "cpu") -> Callable[[], None]:
    gaussians = _decoded(work)
    upstream = torch.randn(work.size.height, work.size.width, 3, generator=torch.Generator().manual_seed(2))
    return lambda: _draw(gaussians, work, options, backend).image.backward(upstream)


def _decoding_and_drawing(work: Workload) -> Callable[[], None]:
    upstream = torch.randn(work.size.height, work.size.width, 3, generator=torch.Generator().manual_seed(2))

    def both_ways() -> None:
        _draw(work.model.decode(work.view).gaussians, work, OPTIONS).image.backward(upstream)
        work.model.zero_grad(set_to_none=True)

    return both_ways


def _decoding(work: Workload, decode: Callable = decode_gaussians) -> Callable[[], None]:
    def both_ways() -> None:
        found = decode(work.model.decoder.weights(), work.model.as_seen(work.view))[0]
        leaves = (found.means, found.quats, found.scales, found.opacities, found.colors)
        torch.autograd.backward(leaves, tuple(map(torch.ones_like, leaves)))
        work.model.zero_grad(set_to_none=True)

    return both_ways


def _comparing(image: Tensor, target: Target) -> Callable[[], None]:
    leaf = image.clone().requires_grad_()
    return lambda: photometric_loss(leaf, target.image, target.weight).backward()


def _defining(image: Tensor, target: Target) -> Callable[[], None]:
    """`_comparing` in torch, with what training keeps of the target where it has no native loss."""
    leaf, moments = image.clone().requires_grad_(), target_moments(target.image)
    total = 3 * target.weight.expand(image.shape[:2]).sum()
    return lambda: define_loss(leaf, target.image, target.weight, LAMBDA_L1, total, moments).backward()


def _ratio(slow_name: str, fast_name: str, slow: Callable, fast: Callable, repeats: int) -> dict[str, Any]:
    slow_time = measure(slow, repeats=repeats, warm_up=1 if repeats > 1 else 0)
    fast_time = measure(fast, repeats=max(3, repeats), warm_up=1)
    return {
        "slow": {"what": slow_name, **slow_time},
        "fast": {"what": fast_name, **fast_time},
        **{clock: slow_time[clock]["min"] / fast_time[clock]["min"] for clock in ("wall", "cpu")},
    }
