"""Several samples a pixel: against a mean over each pixel in closed form, their definition, and finite differences."""

import math
from dataclasses import replace

import pytest
import torch
from support import render_cases as cases
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Panorama, RayTable
from padgs.geometry.panorama import direction
from padgs.render import RenderOptions, render
from padgs.render.contract import ALPHA_MIN
from padgs.render.leave_one_out import leave_one_out
from padgs.render.supersampling import with_smaller_pixels

RAY = RenderOptions("ray", low_pass=0.1)
WIDTH, HEIGHT = 24, 12


def ball(radius: float, sigma: float, opacity: float) -> Gaussians:
    """Return a round Gaussian ahead of the camera, a little aside."""
    one = torch.ones(1, dtype=torch.float64)
    mean = radius * direction(0.13 * one, -0.21 * one)
    quat = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)
    return Gaussians(mean, quat, sigma * one.expand(1, 3), opacity * one, one.expand(1, 3))


def alpha_in_closed_form(gaussian: Gaussians, rays: Tensor) -> Tensor:
    """Return the alpha of a round Gaussian along rays [..., 3]: its largest value is where they pass the mean."""
    along = rays @ gaussian.means[0]
    passed = (gaussian.means[0].square().sum() - along.square()) / gaussian.scales[0, 0].square()
    alpha = gaussian.opacities * torch.exp(-passed / 2) * (along > 0)
    return alpha * (alpha >= ALPHA_MIN)


@cases.each_engine
@pytest.mark.parametrize("times", [2, 3, 8])
def test_a_pixel_is_the_mean_over_its_samples(times: int, backend: str, dtype: torch.dtype):
    gaussian, camera = ball(3.0, 0.2, 0.9), Panorama(WIDTH, HEIGHT)
    options = replace(RAY, supersampling=times, low_pass=0.0)
    drawn = cases.draw(gaussian, WIDTH, HEIGHT, backend=backend, dtype=dtype, options=options)
    rays = Panorama(times * WIDTH, times * HEIGHT).rays(dtype=torch.float64)
    alpha = alpha_in_closed_form(gaussian, rays).view(HEIGHT, times, WIDTH, times).mean((1, 3))
    torch.testing.assert_close((1 - drawn.transmittance).double(), alpha, atol=2e-5, rtol=1e-4)
    one = cases.draw(gaussian, WIDTH, HEIGHT, backend=backend, dtype=dtype, options=replace(options, supersampling=1))
    assert (one.transmittance.double() - (1 - alpha)).abs().max() > 0.05  # a footprint at the centre is not the mean
    assert drawn.image.shape == (camera.height, camera.width, 3)


@cases.each_engine
@cases.each_setup
def test_every_output_is_a_mean_of_the_finer_image(projection: str, lens: str, backend: str, dtype: torch.dtype):
    generator = torch.Generator().manual_seed(3)
    gaussians = cases.mixture(6, generator)
    background = torch.tensor([0.3, 0.6, 0.1])
    options = RenderOptions(projection, low_pass=0.1, supersampling=2)
    view = cases.view_of(cases.camera_of(lens, WIDTH, HEIGHT))
    own = gaussians.to(dtype)
    drawn = render(own, view, options, background=background.to(dtype), backend=backend)
    plain = replace(options, supersampling=1)
    finer = cases.view_of(with_smaller_pixels(view.camera, 2))
    fine = render(own, finer, plain, background=background.to(dtype), backend=backend)

    def mean(samples: Tensor) -> Tensor:
        return samples.view(HEIGHT, 2, WIDTH, 2, -1).mean((1, 3)).squeeze(-1)

    coverage = mean(1 - fine.transmittance)
    torch.testing.assert_close(drawn.image, mean(fine.image))
    torch.testing.assert_close(1 - drawn.transmittance, coverage)
    torch.testing.assert_close(drawn.depth * coverage, mean(fine.depth * (1 - fine.transmittance)))
    assert torch.equal(drawn.visible, fine.visible) and drawn.counters["evaluated"] == fine.counters["evaluated"]


@cases.each_setup
def test_smaller_pixels_see_the_same_directions(projection: str, lens: str):
    camera = cases.camera_of(lens, 10, 6)
    finer = with_smaller_pixels(camera, 3)
    middle = finer.rays(dtype=torch.float64)[1::3, 1::3]  # of the nine samples, the one at the centre of the pixel
    torch.testing.assert_close(middle, camera.rays(dtype=torch.float64))
    assert finer.focal == pytest.approx(3 * camera.focal)


@pytest.mark.parametrize("times", [2, 3])
def test_rays_between_those_of_a_table_are_nearly_those_of_its_lens(times: int):
    panorama = Panorama(96, 48)
    table = RayTable(panorama.rays(dtype=torch.float64), panorama.focal)
    found = with_smaller_pixels(table, times).rays(dtype=torch.float64)
    assert (found - with_smaller_pixels(panorama, times).rays(dtype=torch.float64)).norm(dim=-1).max() < 1e-3
    broken = table.table.clone()
    broken[20, 30] = torch.nan  # beyond the lens
    spoilt = with_smaller_pixels(RayTable(broken, panorama.focal), times).table.isnan().any(-1).nonzero()
    assert len(spoilt) == times**2 and (spoilt // times == torch.tensor([20, 30])).all()
    learned = RayTable(table.table.clone().requires_grad_(), panorama.focal)
    with_smaller_pixels(learned, times).table.sum().backward()
    assert learned.table.grad.isfinite().all() and (learned.table.grad != 0).any()


def test_depth_is_zero_where_nothing_is_drawn():
    drawn = cases.draw(
        ball(3.0, 0.3, 0.9), WIDTH, HEIGHT, backend="torch", dtype=torch.float64, options=replace(RAY, supersampling=2)
    )
    hidden = drawn.transmittance < 1
    assert 0 < hidden.sum() < hidden.numel() and (drawn.depth[~hidden] == 0).all()
    torch.testing.assert_close(drawn.depth[hidden], torch.full_like(drawn.depth[hidden], 3.0))


@pytest.mark.parametrize("lens", ["panorama", "pinhole"])
def test_gradients_match_finite_differences(lens: str):
    generator = torch.Generator().manual_seed(5)
    gaussians = cases.gaussians_of("ordinary", 4, generator)
    factors = torch.rand(6, 12, 5, generator=generator, dtype=torch.float64)
    options = replace(RAY, supersampling=2, low_pass=0.3)

    def value(*tensors: Tensor) -> Tensor:
        own = Gaussians(**dict(zip(cases.INPUTS, tensors, strict=True)))
        out = cases.draw(own, 12, 6, backend="torch", dtype=torch.float64, lens=lens, options=options)
        return (torch.cat((out.image, out.transmittance[..., None], out.depth[..., None]), -1) * factors).sum()

    leaves = cases.leaves(gaussians, torch.float64)
    assert torch.autograd.gradcheck(value, tuple(getattr(leaves, name) for name in cases.INPUTS), eps=1e-7, atol=1e-4)


def test_scores_have_one_sample_a_pixel(generator: torch.Generator):
    gaussians = cases.gaussians_of("ordinary", 8, generator).to(torch.float32)
    view, target = cases.view_of(Panorama(WIDTH, HEIGHT)), torch.rand(HEIGHT, WIDTH, 3, generator=generator)
    weight = torch.ones(HEIGHT, 1)
    one, four = (
        leave_one_out(gaussians, view, target, weight, replace(RAY, supersampling=times), backend="torch")
        for times in (1, 2)
    )
    torch.testing.assert_close(one.change, four.change, rtol=0, atol=0)


def test_a_finer_cubemap_is_averaged_as_well(generator: torch.Generator):
    gaussians = cases.gaussians_of("huge", 4, generator)
    options = replace(RAY, supersampling=2)
    images = [
        cases.draw(gaussians, 64, 32, backend="torch", dtype=torch.float64, options=o).image
        for o in (options, replace(options, cubemap=True))
    ]
    assert (images[0] - images[1]).abs().max() < 0.02 and math.isfinite(images[1].sum().item())


@pytest.mark.parametrize("times", [0, -1, 9])
def test_impossible_numbers_of_samples_are_refused(times: int):
    with pytest.raises(ValueError, match=f"supersampling is {times}; it must be from 1 to 8"):
        RenderOptions(supersampling=times)
