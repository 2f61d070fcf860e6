"""ODGS: its way to a footprint leads where OmniGS is, and what is its own in growing and in its release."""

import math
from dataclasses import replace

import pytest
import torch
from support.composed import composed
from torch import Tensor

from padgs.baselines.odgs import ODGSMethod, ODGSModel, ODGSOptions
from padgs.gaussians import Gaussians
from padgs.geometry.panorama import direction, longitude_latitude, projection_jacobian
from padgs.methods.splats.splats import Splats
from padgs.render import RenderConfig
from padgs.scene import View


def tangent_plane_jacobian(means: Tensor, width: int, height: int) -> Tensor:
    """Jacobian of the pixel by the mean in the steps of ODGS; [N, 2, 3] pixels per unit of length.

    Turn the mean onto the forward axis, where it is (0, 0, r); take the Jacobian of a pinhole of focal length 1 there;
    scale its tangent plane to pixels by W / (2 pi cos(latitude)) and H / pi.
    """
    longitude, latitude = longitude_latitude(means)
    zero, one = torch.zeros_like(longitude), torch.ones_like(longitude)
    sin, cos = longitude.sin(), longitude.cos()
    yaw = torch.stack((cos, zero, -sin, zero, one, zero, sin, zero, cos), dim=-1).unflatten(-1, (3, 3))
    sin, cos = latitude.sin(), latitude.cos()
    pitch = torch.stack((one, zero, zero, zero, cos, -sin, zero, sin, cos), dim=-1).unflatten(-1, (3, 3))
    turned = (pitch @ yaw @ means[..., None])[..., 0]
    x, y, z = turned.unbind(-1)
    assert torch.allclose(turned, torch.stack((zero, zero, means.norm(dim=-1)), dim=-1), atol=1e-12)
    pinhole = torch.stack((1 / z, zero, -x / z**2, zero, 1 / z, -y / z**2), dim=-1).unflatten(-1, (2, 3))
    scale = torch.stack((width / (2 * math.pi * cos), height / math.pi * one), dim=-1)
    return scale[..., None] * (pinhole @ pitch @ yaw)


def test_tangent_plane_jacobian_equals_the_panorama_jacobian(generator):
    means = torch.randn(5000, 3, generator=generator, dtype=torch.float64)
    means = means * torch.logspace(-2, 2, 5000, dtype=torch.float64)[:, None]
    latitude = longitude_latitude(means)[1]
    assert latitude.abs().max() > 1.5, "near the poles too"
    expected = projection_jacobian(means, 2048, 1024)
    difference = (tangent_plane_jacobian(means, 2048, 1024) - expected).abs().amax((1, 2))
    assert (difference / expected.abs().amax((1, 2))).max() < 1e-9
    assert difference[means.norm(dim=-1) > 1].max() < 1e-9


def test_the_method_is_omnigs_with_half_the_threshold():
    odgs, omnigs = composed("method=odgs"), composed("method=omnigs")
    assert odgs.options == replace(ODGSOptions(**vars(omnigs.options)), gradient_threshold=1e-4)
    assert (odgs.render, odgs.train) == (omnigs.render, omnigs.train)
    assert omnigs.options.gradient_threshold == 2e-4


def test_the_release_differs_by_its_deviations_only():
    odgs, release = composed("method=odgs"), composed("method=odgs_release")
    deviations = {"sh_degree": 0, "extent_margin": 100.0, "pixel_bias": 0.5, "prune_by_extent": True}
    assert release.options == replace(odgs.options, **deviations, min_extent=0.0, max_gaussians=None)
    assert release.render == composed("method=padgs", "render=released").render
    assert release.train == odgs.train


def model_of(gaussians: Gaussians, **deviations: float) -> ODGSModel:
    splats = Splats(gaussians.means, gaussians.scales.log(), gaussians.colors, degree=0)
    splats.opacity_logits.data = torch.logit(gaussians.opacities)
    return ODGSModel(splats, ODGSOptions(**deviations), RenderConfig(near=0.0), extent=1.0, iterations=30_000)


def test_pixel_bias_shifts_the_render():
    width, height = 64, 32
    pixels = torch.tensor([[10.5, 16.5], [40.5, 20.5], [50.5, 12.5]])
    angles = (pixels / torch.tensor([width, height]) - 0.5) * torch.tensor([2 * math.pi, math.pi])
    gaussians = Gaussians(
        means=direction(*angles.unbind(-1)),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(3, 1),
        scales=torch.full((3, 3), 0.1),
        opacities=torch.full((3,), 0.9),
        colors=torch.eye(3),
    )
    view = View("v", torch.eye(4, dtype=torch.float64), width, height)
    centred, moved, half = (model_of(gaussians, pixel_bias=bias).render(view).image for bias in (0.0, 1.0, 0.5))
    torch.testing.assert_close(moved, centred.roll((1, 1), (0, 1)), rtol=1e-4, atol=1e-5)
    for number, (u, v) in enumerate(pixels.long().tolist()):
        block = half[v : v + 2, u : u + 2, number]
        torch.testing.assert_close(block, block[:1, :1].expand(2, 2), rtol=1e-3, atol=1e-4)  # centred between four
    drawing = model_of(gaussians, pixel_bias=0.5).draw(view)
    assert torch.equal(drawing.rendering.image, half) and not drawing.mean_offsets.any()
    with pytest.raises(ValueError, match=r"pixel_bias is a deviation of render\.projection=erp, not ray"):
        ODGSMethod(ODGSOptions(pixel_bias=0.5), RenderConfig("ray"))


def test_a_margin_of_an_extent_that_is_not_used_is_refused():
    with pytest.raises(ValueError, match=r"extent_margin=100\.0 is added to the extent, .* length_unit=nearest_camera"):
        ODGSMethod(ODGSOptions(extent_margin=100.0, length_unit="nearest_camera"), RenderConfig())


def test_extent_margin_clones_instead_of_splitting():
    for margin, expected in ((0.0, "cloned 0, split 1"), (100.0, "cloned 1, split 0")):
        model = model_of(
            Gaussians(*(torch.ones(1, n) for n in (3, 4, 3)), torch.full((1,), 0.5), torch.ones(1, 3)),
            extent_margin=margin,
        )
        optimizer = torch.optim.Adam(model.splats.parameters())
        model.densifier.observe(torch.tensor([[1.0, 0.0]]), torch.tensor([True]), 1)
        assert model.densifier.adapt(600, optimizer)[0].startswith(expected)
