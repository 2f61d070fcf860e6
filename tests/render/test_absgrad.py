"""The absolute positional gradient against its definition, in every backend."""

import functools
from dataclasses import replace

import pytest
import torch
from support.render_cases import blended, each_engine, engines, gaussians_of, identity_pose, mixture, row_error
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Panorama, RayTable
from padgs.render import RenderOptions, render
from padgs.scene import View

BLENDINGS = ("sorted", "hybrid")
each_blending = pytest.mark.parametrize("blending", BLENDINGS)


def absgrads(gaussians: Gaussians, view: View, options: RenderOptions, weights: Tensor, backend: str) -> Tensor:
    """Return the absgrad [N] for the outputs [H, W, 3 to 5] times the weights."""
    dtype = gaussians.means.dtype
    absgrad = torch.zeros(len(gaussians), dtype=dtype, requires_grad=True)
    rendering = render(gaussians, view, options, absgrad=absgrad, backend=backend)
    outputs = torch.cat((rendering.image, rendering.transmittance[..., None], rendering.depth[..., None]), dim=-1)
    (outputs[..., : weights.shape[-1]] * weights.to(dtype)).sum().backward()
    assert absgrad.grad is not None
    return absgrad.grad


@each_blending
def test_absgrad_is_the_sum_of_norms_of_single_pixels(blending: str, generator: torch.Generator):
    """By one backward pass for each pixel, in float64; low_pass=0, as the filter's width would follow the means."""
    gaussians = mixture(3, generator, ("ordinary", "polar", "seam", "near"))
    view = View("v", identity_pose().double(), 24, 12)
    options = RenderOptions(projection="ray", low_pass=0.0, steepness=0.25, **blended(blending, 3))
    weights = torch.randn(12, 24, 4, generator=generator, dtype=torch.float64)
    means = gaussians.means.clone().requires_grad_()
    rendering = render(replace(gaussians, means=means), view, options, backend="torch")
    outputs = torch.cat((rendering.image, rendering.transmittance[..., None]), dim=-1)
    losses = (outputs * weights).sum(-1).flatten()
    each = [torch.autograd.grad(loss, means, retain_graph=True)[0] for loss in losses]
    expected = torch.stack(each).norm(dim=-1).sum(0)
    assert (expected > 0).sum() > len(gaussians) // 2
    torch.testing.assert_close(absgrads(gaussians, view, options, weights, "torch"), expected, rtol=1e-9, atol=1e-12)
    assert (torch.stack(each).sum(0).norm(dim=-1) < 0.7 * expected)[expected > 0].any(), "nothing cancels here"


@functools.cache  # for all engines
def case_of(kind: str, channels: int, blending: str) -> tuple[tuple, Tensor]:
    """Return Gaussians, view, options and weights of a case, and their absgrad by the definition."""
    generator = torch.Generator().manual_seed(11)
    gaussians = gaussians_of("huge" if kind == "broad" else kind, 25, generator)
    if kind == "broad":  # with the camera outside
        gaussians = replace(gaussians, scales=0.0625 * gaussians.scales, opacities=0.5 * gaussians.opacities)
    view = View("v", identity_pose(), 70, 44)
    options = RenderOptions(projection="ray", steepness=0.25, **blended(blending, 4))
    case = gaussians, view, options, torch.randn(44, 70, channels, generator=generator, dtype=torch.float64)
    return case, absgrads(*case, "torch")


@each_blending
@pytest.mark.parametrize(("backend", "dtype"), [engine for engine in engines() if torch.float32 in engine.values])
@pytest.mark.parametrize("channels", [3, 5])
@pytest.mark.parametrize("kind", ["ordinary", "polar", "seam", "near", "broad"])
def test_backends_agree(kind: str, channels: int, blending: str, backend: str, dtype: torch.dtype):
    (gaussians, *others), expected = case_of(kind, channels, blending)
    found = absgrads(gaussians.to(dtype), *others, backend)
    assert expected.any()
    assert row_error(found[:, None], expected[:, None]) < 2e-3


@each_engine
def test_absgrad_with_learned_rays(backend: str, dtype: torch.dtype, generator: torch.Generator):
    formula = Panorama(40, 20)
    gaussians, options = mixture(5, generator, ("ordinary", "seam")).to(dtype), RenderOptions(projection="ray")
    weights = torch.randn(20, 40, 3, generator=generator, dtype=torch.float64)
    table = formula.rays(dtype=dtype).clone()
    fixed = View("v", identity_pose(), 40, 20, lens=RayTable(table, formula.focal))
    learned = View("v", identity_pose(), 40, 20, lens=RayTable(table.clone().requires_grad_(), formula.focal))
    expected = absgrads(gaussians, fixed, options, weights, backend)
    assert expected.any()
    torch.testing.assert_close(absgrads(gaussians, learned, options, weights, backend), expected, rtol=1e-5, atol=1e-7)


@each_engine
def test_absgrad_is_per_length_and_changes_no_other_gradient(
    backend: str, dtype: torch.dtype, generator: torch.Generator
):
    """Doubling the world halves absgrad, and absgrad changes no image and no other gradient."""
    gaussians, view = mixture(5, generator).to(dtype), View("v", identity_pose(), 40, 20)
    options, weights = RenderOptions(projection="ray"), torch.rand(20, 40, 3, generator=generator).double()
    twice = replace(gaussians, means=2 * gaussians.means, scales=2 * gaussians.scales)
    once = absgrads(gaussians, view, options, weights, backend)
    torch.testing.assert_close(absgrads(twice, view, options, weights, backend), 0.5 * once, rtol=1e-4, atol=1e-6)

    gradients = []
    for absgrad in (None, torch.zeros(len(gaussians), dtype=dtype, requires_grad=True)):
        means = gaussians.means.clone().requires_grad_()
        drawn = render(replace(gaussians, means=means), view, options, absgrad=absgrad, backend=backend)
        (drawn.image * weights.to(dtype)).sum().backward()
        gradients.append((drawn.image, means.grad))
    assert torch.equal(gradients[0][0], gradients[1][0])
    torch.testing.assert_close(gradients[1][1], gradients[0][1], rtol=1e-5, atol=1e-7)


def test_absgrad_of_a_cubemap(generator: torch.Generator):
    """Pixels interpolated from finer faces give about the absgrad of the panorama."""
    gaussians, view = mixture(5, generator, ("ordinary", "seam")), View("v", identity_pose(), 64, 32)
    options = RenderOptions(projection="ray", low_pass=0.0)  # a pixel of the faces is smaller
    weights = torch.ones(32, 64, 3, dtype=torch.float64)
    whole = absgrads(gaussians, view, options, weights, "torch")
    faces = absgrads(gaussians, view, replace(options, cubemap=True), weights, "torch")
    seen = whole > 0.1 * whole.max()
    assert (faces[seen] / whole[seen] - 1).abs().median() < 0.2
