"""Rays of training pixels, samples along rays, and weights of intervals."""

from dataclasses import replace

import pytest
import torch
from support.tiny_scene import tiny_scene

from padgs.geometry.camera import Pinhole
from padgs.methods.egonerf.grids import inverse_cdf, refined, visible_shares
from padgs.methods.egonerf.model import RayPixels
from padgs.scene import View


@pytest.fixture
def views() -> tuple[View, ...]:
    """Panoramas that look in several directions, and a perspective picture among them."""
    first, second, third, *_ = tiny_scene().train
    turn = torch.tensor([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
    pixels = torch.arange(6 * 8 * 3, dtype=torch.uint8).reshape(6, 8, 3)
    lens = Pinhole(8, 6, 5.0, 5.0, 4.0, 3.0)
    photo = View("photo", turn @ third.cam_from_world, 8, 6, lambda: pixels, lens=lens)
    return first, replace(second, cam_from_world=turn @ second.cam_from_world), photo


def test_rays_match_their_pixels(views):
    pixels = RayPixels(views)
    start = 0
    for view in views:
        count = view.width * view.height
        rays = pixels.at(torch.arange(start, start + count))
        assert torch.equal(rays.color, view.image().reshape(-1, 3))
        assert torch.allclose(rays.origins, view.center.expand(count, 3))
        seen = rays.directions.double() @ view.cam_from_world[:3, :3].T
        assert torch.allclose(seen, view.camera.rays(dtype=torch.float64).reshape(-1, 3), atol=1e-6)
        start += count
    assert len(pixels) == start


def test_pixels_are_drawn_uniformly_over_all_views(views):
    rays = RayPixels(views).draw(50_000)
    in_photo = (rays.origins == views[2].center).all(-1).double().mean().item()
    assert in_photo == pytest.approx(48 / (48 + 2 * 512), abs=0.004)
    up = (rays.directions[:, 1] < -0.9).double().mean().item()
    assert up > 1.5 * 0.05, "over pixels, not over the sphere, of which that is a twentieth"
    assert torch.equal(RayPixels(views[:2]).draw(100).weight, torch.ones(100))


def test_views_weigh_as_where_whole_views_are_drawn(views):
    first, second, photo = views
    views = [first, replace(second, share=0.3), replace(photo, sphere_share=0.1)]
    weights = RayPixels(views).at(torch.arange(2 * 512 + 48)).weight.split((512, 512, 48))
    assert [part.sum().item() / 512 for part in weights] == pytest.approx([1, 0.3, 0.1])


def test_masks_select_and_weight_pixels(views):
    mask = torch.ones(16, 32)
    mask[:8], mask[8] = 0, 0.25
    pixels = RayPixels([replace(views[0], load_mask=lambda: mask)])
    assert len(pixels) == 8 * 32
    rays = pixels.draw(5000)
    assert (rays.directions[:, 1] > 0).all(), "the upper half is masked"
    assert set(rays.weight.tolist()) == {0.25, 1.0}


def test_solid_angle_weights(views):
    rays = RayPixels([views[0]], "solid_angle").draw(1000)
    assert torch.allclose(rays.weight, rays.directions[:, [0, 2]].norm(dim=-1), atol=1e-5)


def test_unusable_views_are_refused(views):
    with pytest.raises(ValueError, match="view '00': the mask is 0 everywhere"):
        RayPixels([replace(views[0], load_mask=lambda: torch.zeros(16, 32))])
    with pytest.raises(ValueError, match="image of view '00' is 32x16; the view is 64x32"):
        RayPixels([replace(views[0], width=64, height=32)])


def test_quantiles_of_an_exponential_density():
    """Density exp(-x) on [0, 8], cut finely: the quantile of share u is -log(1 - u (1 - exp(-8)))."""
    edges = torch.linspace(0, 8, 20_001, dtype=torch.float64)[None]
    weights = torch.exp(-edges[:, :-1]) - torch.exp(-edges[:, 1:])
    shares = torch.linspace(0.001, 0.999, 500, dtype=torch.float64)[None]
    exact = -torch.log1p(-shares * (1 - torch.exp(torch.tensor(-8.0, dtype=torch.float64))))
    assert torch.allclose(inverse_cdf(edges, weights, shares), exact, atol=2e-5)


def test_quantiles_of_piecewise_constant_densities(generator):
    edges = torch.tensor([[1.0, 2.0, 4.0, 5.0], [0.0, 1.0, 2.0, 3.0]], dtype=torch.float64)
    weights = torch.tensor([[1.0, 2.0, 1.0], [1e-12, 1.0, 1e-12]], dtype=torch.float64)
    shares = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0], dtype=torch.float64).expand(2, 5)
    found = inverse_cdf(edges, weights, shares)
    assert torch.allclose(found[0], torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0], dtype=torch.float64))
    assert torch.allclose(found[1, 1:4], torch.tensor([1.25, 1.5, 1.75], dtype=torch.float64))
    random = torch.rand(2, 1000, dtype=torch.float64, generator=generator).sort(dim=-1).values
    assert (inverse_cdf(edges, weights, random).diff(dim=-1) >= 0).all()


def test_refined_samples_follow_the_weights():
    distances = torch.arange(1.0, 11.0)[None]
    weights = torch.zeros(1, 10)
    empty = refined(distances, weights, torch.linspace(0, 1, 9)[None])
    assert torch.allclose(empty, torch.linspace(1.5, 9.5, 9)[None]), "an empty ray is sampled everywhere"
    weights[0, 4] = 1.0  # at distance 5
    found = refined(distances, weights, torch.linspace(0.01, 0.99, 50)[None])
    assert ((found >= 4.5) & (found <= 5.5)).all()


DENSITY = 0.7


def test_weights_and_residual_sum_to_one(generator):
    depths = torch.rand(1000, 40, generator=generator) ** 8 * 20
    weights, residual = visible_shares(depths)
    assert (weights >= 0).all() and (residual >= 0).all()
    assert torch.allclose(weights.sum(-1) + residual, torch.ones(1000), atol=2e-6)


def test_constant_density_is_exact_for_any_intervals(generator):
    """The share of light from the first length s is 1 - exp(-density s)."""
    lengths = torch.rand(30, dtype=torch.float64, generator=generator)
    lengths = torch.cat((torch.zeros(5), lengths, torch.zeros(5)))  # empty space before and behind
    weights, residual = visible_shares(DENSITY * lengths)
    assert weights[:5].sum() == weights[-5:].sum() == 0
    assert torch.allclose(weights.cumsum(0), 1 - torch.exp(-DENSITY * lengths.cumsum(0)), atol=1e-14)
    assert torch.allclose(residual, torch.exp(-DENSITY * lengths.sum()))


def test_opaque_empty_and_faint_media():
    weights, residual = visible_shares(torch.tensor([[0.0, 0.0, 0.0], [0.0, 1e4, 5.0]]))
    assert weights.tolist() == [[0, 0, 0], [0, 1, 0]] and residual.tolist() == [1, 0]
    assert torch.allclose(visible_shares(torch.full((4,), 1e-9))[0], torch.full((4,), 1e-9), rtol=1e-6)


def test_gradients(generator):
    depths = torch.rand(3, 5, dtype=torch.float64, generator=generator, requires_grad=True)
    assert torch.autograd.gradcheck(visible_shares, depths)
