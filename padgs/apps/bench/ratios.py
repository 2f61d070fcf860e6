"""The same work done in two ways, one after the other in the same run: what each of our choices is worth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from padgs.apps.bench.tile_counts import BOUNDS
from padgs.apps.bench.workload import OPTIONS, Workload
from padgs.clock import measure
from padgs.gaussians import Gaussians
from padgs.methods.anchors.decoder import decode_gaussians, define_gaussians
from padgs.render import RenderOptions, render
from padgs.training.loss import define_loss, photometric_loss, target_moments
from padgs.training.options import TrainOptions
from padgs.training.targets import Target, Targets

LAMBDA_L1 = TrainOptions().lambda_l1
PROJECTIONS = {
    "tangent": ("draw with tangent", replace(OPTIONS, projection="tangent")),
    "ray": ("draw with ray", replace(OPTIONS, projection="ray")),
    "hybrid": ("draw with ray, hybrid", replace(OPTIONS, projection="ray", blending="hybrid")),  # SPaGS
}


def ratios(work: Workload, brute_force: Workload, repeats: int) -> dict[str, dict[str, Any]]:
    """Name -> how many times longer the slow way takes.

    Args:
        work: what everything but the torch renderer is timed on.
        brute_force: less, for the torch renderer, whose work is the product of pixels and Gaussians. On larger images
            it falls further behind.
        repeats: of each.
    """

    def ratio(slow_name: str, fast_name: str, slow: Callable, fast: Callable, repeats: int = repeats) -> dict[str, Any]:
        slow_time = measure(slow, repeats=repeats, warm_up=1 if repeats > 1 else 0)
        return compared(slow_name, fast_name, slow_time, measure(fast, repeats=max(3, repeats), warm_up=1))

    def of_options(slow_name: str, fast_name: str, slow: RenderOptions, fast: RenderOptions) -> dict[str, Any]:
        """The same Gaussians drawn in two ways, forward and backward."""
        more, less = (render(_decoded(work), work.view, way, backend="cpu").counters for way in (slow, fast))
        counts = {count: more[count] / less[count] for count in ("instances", "evaluated")}
        return ratio(slow_name, fast_name, _drawing(work, slow), _drawing(work, fast)) | counts

    target = Targets(work.scene.train[:1], "solid_angle")[0]
    image = torch.rand(work.size.height, work.size.width, 3, generator=torch.Generator().manual_seed(1))
    by_hand, native = _drawing(brute_force, OPTIONS, "torch"), _drawing(brute_force, OPTIONS)
    size = {"size": [brute_force.size.width, brute_force.size.height, brute_force.size.gaussians]}
    bounds = ("published bounds (square, no wrap)", "exact bounds", BOUNDS["square"], BOUNDS["exact"])
    losses = _defining(image, target), _comparing(image, target)
    return {
        "torch_renderer": ratio("torch renderer", "native renderer", by_hand, native, 1) | size,
        "published_bounds": of_options(*bounds),
        "torch_decode": ratio("torch decoder", "native decoder", _decoding(work, define_gaussians), _decoding(work)),
        "torch_loss": ratio("torch loss", "native loss", *losses),
        "decode": ratio("decode, draw with erp", "draw with erp", _decoding_too(work), _drawing(work, OPTIONS)),
        **{name: of_options(title, "draw with erp", way, OPTIONS) for name, (title, way) in PROJECTIONS.items()},
    }


def compared(slow_name: str, fast_name: str, slow: dict[str, Any], fast: dict[str, Any]) -> dict[str, Any]:
    """Two timings and how many times longer the first is, by either clock."""
    return {
        "slow": {"what": slow_name, **slow},
        "fast": {"what": fast_name, **fast},
        **{clock: slow[clock]["min"] / fast[clock]["min"] for clock in ("wall", "cpu")},
    }


def render_both_ways(work: Workload, repeats: int) -> dict[str, Any]:
    """Time drawing fixed Gaussians and going back to their gradients, natively."""
    return measure(_drawing(work, OPTIONS), repeats=repeats)


def _decoded(work: Workload) -> Gaussians:
    with torch.no_grad():
        found = work.model.decode(work.view).gaussians
    return Gaussians(*(leaf.clone().requires_grad_() for leaf in vars(found).values()))


def _drawing(work: Workload, options: RenderOptions, backend: str = "cpu") -> Callable[[], None]:
    gaussians, upstream = _decoded(work), _upstream(work)
    return lambda: render(gaussians, work.view, options, backend=backend).image.backward(upstream)


def _decoding_too(work: Workload) -> Callable[[], None]:
    upstream = _upstream(work)

    def both_ways() -> None:
        gaussians = work.model.decode(work.view).gaussians
        render(gaussians, work.view, OPTIONS, backend="cpu").image.backward(upstream)
        work.model.zero_grad(set_to_none=True)

    return both_ways


def _upstream(work: Workload) -> Tensor:
    return torch.randn(work.size.height, work.size.width, 3, generator=torch.Generator().manual_seed(2))


def _decoding(work: Workload, decode: Callable = decode_gaussians) -> Callable[[], None]:
    def both_ways() -> None:
        leaves = vars(decode(work.model.decoder.weights(), work.model.as_seen(work.view))[0]).values()
        torch.autograd.backward(tuple(leaves), tuple(map(torch.ones_like, leaves)))
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
