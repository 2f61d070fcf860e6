"""Positional gradients against their formulas."""

import math
from dataclasses import replace

import pytest
import torch

from padgs.gaussians import rotation_matrices
from padgs.geometry.panorama import direction
from padgs.methods.splats.method import SplatMethod, SplatOptions
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import Splats
from padgs.render import RenderConfig, Rendering, RenderOptions, render
from padgs.scene import View

RAY = RenderOptions(projection="ray")


def colored_splats(count: int, generator: torch.Generator) -> Splats:
    """Gaussians all around, float64, whose colours depend on the direction they are seen from."""
    means = 2 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    log_scales = torch.log(0.05 + 0.3 * torch.rand(count, 3, generator=generator, dtype=torch.float64))
    splats = Splats(means, log_scales, torch.rand(count, 3, generator=generator, dtype=torch.float64))
    splats.sh_rest.data.normal_(0, 0.1, generator=generator)
    splats.active_degree = 3
    return splats


def drawn(splats: Splats, view: View, kind: str, **config) -> tuple[Rendering, torch.Tensor]:
    """A training render by the torch backend, and its mean offsets, whose gradient is the positional gradient."""
    render_config = RenderConfig(backend="torch", near=0.0, **config)
    options = SplatOptions(positional_gradient=kind)
    drawing = SplatModel(splats, options, render_config, extent=1.0, iterations=100).draw(view)
    return drawing.rendering, drawing.mean_offsets


def view_at(generator: torch.Generator | None, width: int = 48) -> View:
    """A panorama from somewhere, turned; without a generator from the origin."""
    pose = torch.eye(4, dtype=torch.float64)
    if generator is not None:
        pose[:3, :3] = rotation_matrices(torch.randn(4, generator=generator, dtype=torch.float64))
        pose[:3, 3] = 0.3 * torch.randn(3, generator=generator, dtype=torch.float64)
    return View("v", pose, width, width // 2)


@pytest.mark.parametrize("projection", ["erp", "tangent", "ray"])
def test_space_is_half_the_distance_times_the_gradient_of_the_mean(projection, generator):
    """By autograd, in float64, with a pose that is turned and shifted: 0.5 |mean - centre| |dL/dmean|.

    The direction of the mean, which its colour depends on, counts.
    """
    splats, view = colored_splats(30, generator), view_at(generator)
    options, weight = RenderOptions(projection=projection), torch.rand(24, 48, 3, generator=generator).double()
    rendering, offsets = drawn(splats, view, "space", projection=projection)
    (weight * rendering.image).sum().backward()

    gaussians = splats.gaussians(view)
    plain = render(gaussians, view, options)
    painted = render(replace(gaussians, colors=gaussians.colors.detach()), view, options)
    whole, footprint = (
        torch.autograd.grad((weight * drawn.image).sum(), splats.means, retain_graph=True)[0]
        for drawn in (plain, painted)
    )
    assert (whole - footprint).norm() > 0.1 * whole.norm(), "colours matter here"
    in_camera = view.cam_from_world[:3, :3] @ splats.means.detach().T + view.cam_from_world[:3, 3:]
    expected = 0.5 * in_camera.norm(dim=0) * whole.norm(dim=-1)
    assert offsets.grad is not None
    assert torch.equal(rendering.image, plain.image), "offsets of zeros move nothing"
    assert (expected > 0).sum() > 20
    assert torch.allclose(offsets.grad.norm(dim=-1), expected, rtol=1e-9, atol=1e-14)


def test_the_gradient_in_space_is_invariant_to_rotation_and_scale(generator):
    """r |dL/dmean| is per radian: neither rotating nor scaling the world changes it."""
    norms_by = []
    for scale, axis in ((1.0, 2), (1.0, 0), (3.0, 2)):
        splats = colored_splats(1, generator)
        splats.means.data = torch.zeros(1, 3).double()
        splats.means.data[0, axis] = 2 * scale
        splats.log_scales.data[:] = torch.tensor(0.2 * scale).double().log()
        splats.sh_dc.data[:] = 1.0
        splats.active_degree = 0
        view = view_at(None, width=256)
        rendering, offsets = drawn(splats, view, "space", projection="ray")
        rays = view.camera.rays(dtype=torch.float64)
        aside = (splats.means.detach()[0].roll(1) / (2 * scale) * rays).sum(-1)  # odd about the ball's centre
        (rendering.image.sum(-1) * aside * (1 - rays[..., 1] ** 2).sqrt()).sum().backward()
        norms_by.append(offsets.grad.norm().item())
    assert norms_by[1] == pytest.approx(norms_by[0], rel=2e-3)
    assert norms_by[2] == pytest.approx(norms_by[0], rel=1e-6)


@pytest.mark.parametrize("latitude", [15.0, 45.0, 70.0])
@pytest.mark.parametrize("projection", ["tangent", "ray"])
def test_the_gradient_in_the_image_has_the_same_unit_in_every_projection(projection, latitude, generator):
    """One threshold fits all projections: medians over many small Gaussians agree to some percent."""
    count, width = 60, 256
    longitude = math.pi * (2 * torch.rand(count, generator=generator, dtype=torch.float64) - 1)
    means = 2 * direction(longitude, torch.full_like(longitude, math.radians(latitude)))
    sizes = 2 * 2 * math.pi / width * (0.6 + 0.8 * torch.rand(count, 3, generator=generator, dtype=torch.float64))
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    splats = Splats(means, sizes.log(), torch.rand(count, 3, generator=generator).double())
    splats.quats.data, splats.opacity_logits.data = quats, torch.zeros_like(longitude)
    blobs = torch.rand(1, 3, 8, 16, generator=generator, dtype=torch.float64)
    target = torch.nn.functional.interpolate(blobs, (width // 2, width), mode="bicubic")[0].permute(1, 2, 0)
    norms_by = {}
    for name, kind in (("erp", "pixels"), (projection, "angular")):
        rendering, offsets = drawn(splats, view_at(None, width), "image", projection=name, low_pass_kind=kind)
        ((rendering.image - target) ** 2).mean().backward()
        assert offsets.grad is not None
        norms_by[name] = offsets.grad.norm(dim=-1)
    assert (norms_by[projection] / norms_by["erp"]).median().item() == pytest.approx(1, abs=0.15)


def test_space_absolute_adds_half_the_distance_times_the_absolute_gradients_of_pixels(generator):
    """The gradient in space itself does not change."""
    splats, view = colored_splats(30, generator), view_at(generator)
    gaussians, weight = splats.gaussians(view), torch.randn(24, 48, 3, generator=generator).double()
    gradients = []
    for kind in ("space", "space_absolute"):
        rendering, offsets = drawn(splats, view, kind, projection="ray")
        (weight * rendering.image).sum().backward()
        gradients.append(offsets.grad)
    assert torch.equal(gradients[0], gradients[1][:, :3])

    absolute = torch.zeros(30, dtype=torch.float64, requires_grad=True)
    (weight * render(gaussians, view, RAY, absgrad=absolute).image).sum().backward()
    distance = (gaussians.means.detach() @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]).norm(dim=-1)
    assert absolute.grad is not None and (absolute.grad > 0).sum() > 20
    assert torch.allclose(gradients[1][:, 3], 0.5 * distance * absolute.grad, rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize(("kind", "axes"), [("image", 2), ("space", 3), ("space_absolute", 4)])
def test_the_densifier_observes_the_gradient_of_its_options(kind, axes, generator):
    splats, render_config = colored_splats(10, generator), RenderConfig(backend="torch", projection="ray")
    model = SplatModel(splats, SplatOptions(positional_gradient=kind), render_config, extent=1.0, iterations=100)
    drawing = model.draw(view_at(generator))
    drawing.rendering.image.sum().backward()
    assert drawing.mean_offsets.grad is not None and drawing.mean_offsets.grad.shape == (10, axes)
    model.observe(drawing, 1)
    norms = torch.where(drawing.rendering.visible, drawing.mean_offsets.grad[:, :3].norm(dim=-1), 0.0)
    assert torch.equal(model.densifier.statistics["gradient"], norms)
    assert norms.sum() > 0
    if axes == 4:
        assert torch.equal(model.densifier.statistics["absolute"], drawing.mean_offsets.grad[:, 3])


def test_space_absolute_needs_projection_ray():
    with pytest.raises(
        ValueError, match=r"space_absolute is made for render\.projection=ray, not erp; set .*positional_gradient=space"
    ):
        SplatMethod(SplatOptions(positional_gradient="space_absolute"), RenderConfig())
