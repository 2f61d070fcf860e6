from dataclasses import replace

import pytest
import torch
from tiny_scene import tiny_scene

from padgs.geometry.camera import Pinhole
from padgs.methods.egonerf.rays import RayPixels
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


def masked(view: View, mask: torch.Tensor) -> View:
    return replace(view, load_mask=lambda: mask)


def test_every_pixel_is_the_ray_of_its_own_view(views):
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
    assert torch.equal(rays.weight, torch.ones(50_000))


def test_masked_pixels_are_never_drawn_and_others_weigh_as_the_mask_says(views):
    mask = torch.ones(16, 32)
    mask[:8], mask[8] = 0, 0.25
    pixels = RayPixels([masked(views[0], mask)])
    assert len(pixels) == 8 * 32
    rays = pixels.draw(5000)
    assert (rays.directions[:, 1] > 0).all(), "the upper half is masked"
    assert set(rays.weight.tolist()) == {0.25, 1.0}


def test_rows_may_weigh_by_solid_angle(views):
    rays = RayPixels([views[0]], "solid_angle").draw(1000)
    assert torch.allclose(rays.weight, rays.directions[:, [0, 2]].norm(dim=-1), atol=1e-5)


def test_views_without_use_are_named(views):
    with pytest.raises(ValueError, match="view '00': the mask is 0 everywhere"):
        RayPixels([masked(views[0], torch.zeros(16, 32))])
    with pytest.raises(ValueError, match="image of view '00' is 32x16; the view is 64x32"):
        RayPixels([replace(views[0], width=64, height=32)])
