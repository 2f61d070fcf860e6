"""Photographs through lenses with distortion are drawn in blocks, which change nothing but the time."""

import math
from dataclasses import fields

import pytest
import torch
from support.render_cases import needs_native

from padgs.gaussians import Gaussians
from padgs.geometry.camera import RayTable, perspective
from padgs.render import RenderOptions, make_request, render
from padgs.render.leave_one_out import leave_one_out
from padgs.render.ray_blocks import BLOCK, rasterize_blocks
from padgs.scene import View

WIDTH, HEIGHT = 150, 100  # no multiples of BLOCK
COUNT = 600


def distorted() -> RayTable:
    camera = perspective(WIDTH, HEIGHT, 80.0)
    rays = camera.rays()
    plane = rays[..., :2] / rays[..., 2:]
    plane = plane * (1 - 0.2 * plane.square().sum(-1, keepdim=True))
    ahead = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
    return RayTable(torch.nn.functional.normalize(ahead, dim=-1), camera.focal, "opencv")


def fisheye() -> RayTable:
    """An equidistant image of 200 degrees across."""
    focal = WIDTH / math.radians(200)
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5 - HEIGHT / 2, torch.arange(WIDTH) + 0.5 - WIDTH / 2, indexing="ij")
    radius = torch.sqrt(x * x + y * y)
    angle = radius / focal
    side = torch.sin(angle) / radius.clamp(min=1e-9)
    return RayTable(torch.stack([x * side, y * side, torch.cos(angle)], -1), focal, "opencv_fisheye")


def cloud(generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Gaussians all around, of all sizes, some of them around the camera and some too faint to be drawn."""
    means = torch.randn(COUNT, 3, generator=generator)
    means = means / means.norm(dim=-1, keepdim=True) * (0.05 + 4 * torch.rand(COUNT, 1, generator=generator))
    scales = 10 ** (-2.5 + 2.5 * torch.rand(COUNT, 3, generator=generator))
    return {
        "means": means,
        "quats": torch.randn(COUNT, 4, generator=generator),
        "scales": scales,
        "opacities": torch.rand(COUNT, generator=generator).square(),
        "colors": torch.rand(COUNT, 3, generator=generator),
    }


@needs_native
@pytest.mark.parametrize("make", [distorted, fisheye])
@pytest.mark.parametrize("projection", ["ray", "tangent"])
def test_blocks_give_the_image_the_gradients_and_the_scores_of_the_whole(make, projection, generator):
    from padgs.render.backends import cpu

    camera, values, found = make(), cloud(generator), []
    assert WIDTH % BLOCK and HEIGHT % BLOCK
    view, options = View("a", torch.eye(4), WIDTH, HEIGHT, lens=camera), RenderOptions(projection=projection)
    weights = torch.randn(HEIGHT, WIDTH, 5, generator=generator)
    for whole in (True, False):
        leaves = {name: tensor.clone().requires_grad_() for name, tensor in values.items()}
        request = make_request(Gaussians(**leaves), view, options)
        rendering = cpu.rasterize(request) if whole else rasterize_blocks(cpu.rasterize, request)
        channels = (rendering.image, rendering.transmittance[..., None], rendering.depth[..., None])
        (torch.cat(channels, -1) * weights).sum().backward()
        found.append((rendering, {name: leaf.grad for name, leaf in leaves.items()}))
    (whole, gradients), (blocks, of_blocks) = found
    for name in ("image", "transmittance", "depth"):
        torch.testing.assert_close(getattr(blocks, name), getattr(whole, name), atol=1e-6, rtol=1e-6)
    for name, gradient in gradients.items():
        torch.testing.assert_close(of_blocks[name], gradient, atol=1e-4 * gradient.abs().max().item(), rtol=1e-4)
    assert blocks.counters["contributing"] == whole.counters["contributing"]
    assert blocks.counters["evaluated"] < 0.6 * whole.counters["evaluated"]
    used = torch.stack([gradient.reshape(COUNT, -1).abs().sum(1) for gradient in gradients.values()]).sum(0) > 0
    assert not (used & ~blocks.visible).any() and blocks.visible.sum() < whole.visible.sum()
    target = torch.rand(HEIGHT, WIDTH, 3, generator=generator)
    weight = torch.rand(HEIGHT, WIDTH, generator=generator)
    scored = leave_one_out(Gaussians(**values), view, target, weight, options)
    request = make_request(Gaussians(**values), view, options)
    normed = (weight / weight.double().sum()).float()
    expected = cpu.leave_one_out(request, target, normed)
    for field in fields(scored):
        share = 3 if field.name in ("error", "change") else 1
        truth = getattr(expected, field.name) / share
        torch.testing.assert_close(getattr(scored, field.name), truth, atol=1e-9, rtol=1e-4)


@needs_native
@pytest.mark.parametrize("make", [distorted, fisheye])
def test_backends_agree_on_which_gaussians_a_photograph_shows(make, generator):
    """Else densification would depend on the backend."""
    gaussians = Gaussians(**cloud(generator))
    view, options = View("a", torch.eye(4), WIDTH, HEIGHT, lens=make()), RenderOptions(projection="ray")
    one, other = (render(gaussians, view, options, backend=name).visible for name in ("torch", "cpu"))
    assert torch.equal(one, other) and 0.1 * COUNT < one.sum() < 0.9 * COUNT
