"""The 3D smoothing filter: no render is finer than the training views."""

import pytest
import torch
from support.tiny_scene import tiny_scene

from padgs.geometry.camera import perspective
from padgs.methods.plus.method import PlusMethod, PlusOptions
from padgs.methods.splats.smoothing_filter import RESOLVED_PIXEL, cameras_of, finest_pixels, smoothed_for_view
from padgs.render import render
from padgs.render.projection import LowPass, low_pass_filtered
from padgs.scene import View
from padgs.training.options import Budget

# Gaussians at equal distances are blended in their order; these options leave few.
OPTIONS = PlusOptions(initial_per_pixel=None, split="random")


@pytest.fixture(scope="module")
def trained():
    method = PlusMethod(OPTIONS)
    list(method.fit(tiny_scene(), Budget(20)))
    return method


def close_up(view: View) -> View:
    return View("close", view.cam_from_world, 96, 96, lens=perspective(96, 96, 90))


def test_the_finest_pixel_depends_on_distance_and_focal_length():
    cameras = torch.tensor([[0.0, 0, 0, 10], [4.0, 0, 0, 10], [0.0, 0, 0, 20]], dtype=torch.float64)
    found = finest_pixels(torch.tensor([[1.0, 0, 0], [3.9, 0, 0], [0, 8.0, 0]]), cameras)
    assert found.tolist() == pytest.approx([1 / 20, 0.1 / 10, 8 / 20])
    assert not finest_pixels(torch.ones(2, 3), cameras[:0]).any()


def test_with_the_low_pass_of_the_view_the_larger_pixel_results(trained):
    view, variance = tiny_scene().train[0], 0.1
    gaussians = trained.model.splats.gaussians(view)
    distances = (gaussians.means - view.center.float()).norm(dim=-1)
    own = distances / view.camera.focal
    pixels = own * torch.linspace(0.5, 3, len(own))
    seen = low_pass_filtered(
        smoothed_for_view(gaussians, view, pixels, variance),
        gaussians.means - view.center.float(),
        LowPass(0.0, variance / view.camera.focal**2, compensate=True),
    )
    wide = torch.sqrt(gaussians.scales**2 + variance * torch.maximum(own, RESOLVED_PIXEL * pixels)[:, None] ** 2)
    torch.testing.assert_close(seen.scales, wide)
    torch.testing.assert_close(seen.opacities, gaussians.opacities * (gaussians.scales / wide).prod(-1))


def test_training_views_are_unchanged_and_closer_views_are_smoothed(trained):
    model, scene = trained.model, tiny_scene()

    def plainly(view: View):
        return render(model.splats.gaussians(view), view, model.render_options(view)).image

    for view in scene.train:
        torch.testing.assert_close(model.render(view).image, plainly(view), atol=1e-5, rtol=0)
    near = close_up(scene.train[0])
    difference = (model.render(near).image - plainly(near)).abs().max()
    assert difference > 0.01
    pixels = finest_pixels(model.splats.means, cameras_of(scene.train))
    wider = smoothed_for_view(model.splats.gaussians(near), near, pixels, trained.render_config.low_pass)
    drawn = render(wider, near, model.render_options(near)).image
    assert torch.equal(model.render(near).image, drawn)


def test_the_filter_survives_loading_and_pruning(trained):
    view = close_up(tiny_scene().train[1])
    loaded = PlusMethod(OPTIONS)
    loaded.load_state(trained.state())
    assert torch.equal(loaded.render(view).image, trained.render(view).image)
    kept = torch.arange(len(loaded.model.splats)) % 2 == 0
    loaded.model.keep(kept)
    pixels = finest_pixels(loaded.model.splats.means, cameras_of(tiny_scene().train))
    wider = smoothed_for_view(loaded.model.splats.gaussians(view), view, pixels, loaded.render_config.low_pass)
    drawn = render(wider, view, loaded.model.render_options(view)).image
    assert torch.equal(loaded.render(view).image, drawn)


def test_the_order_of_rows_does_not_matter(trained):
    view, model = close_up(tiny_scene().train[0]), trained.model
    before, stored = model.render(view).image, model.splats.state_dict()
    rows = {name: tensor.flip(0) if name in model.splats.rows() else tensor for name, tensor in stored.items()}
    model.splats.load(rows)
    torch.testing.assert_close(model.render(view).image, before, atol=1e-5, rtol=0)
    model.splats.load(stored)
