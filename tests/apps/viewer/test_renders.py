from dataclasses import replace

import numpy as np
import pytest
import torch
from support.tiny_run import tiny_run

import padgs
from padgs.apps.viewer.renders import RunRenderer, ViewOptions, side_by_side
from padgs.evaluation.images import to_uint8


@pytest.fixture(scope="module")
def renderer(tmp_path_factory) -> RunRenderer:
    return RunRenderer(padgs.load_run(tiny_run(tmp_path_factory), device="cpu"))


@pytest.fixture(scope="module")
def anchors(tmp_path_factory) -> RunRenderer:
    return RunRenderer(padgs.load_run(tiny_run(tmp_path_factory, "method=padgs_small"), device="cpu"))


def test_panoramas_are_padded_renders_of_the_run(renderer):
    view = renderer.run.scene.train[1]
    image = renderer.render(ViewOptions("panorama"), view.cam_from_world, 32, 24)
    assert image.shape == (24, 32, 3) and image[:4].max() == image[20:].max() == 0
    assert np.array_equal(image[4:20], to_uint8(renderer.run.method.render(view).image))
    high = renderer.render(ViewOptions("panorama"), view.cam_from_world, 32, 8)
    assert high.shape == (8, 16, 3), "no wider than its height allows"


@pytest.mark.parametrize("camera", ["perspective", "panorama"])
@pytest.mark.parametrize("layer", ["colours", "depth", "error"])
def test_all_layers_cameras_and_resolutions(renderer, anchors, camera, layer):
    for shown in (renderer, anchors):
        pose = shown.run.scene.train[0].cam_from_world
        full = shown.render(ViewOptions(camera, layer), pose, 40, 20)
        assert full.shape == (20, 40, 3) and full.dtype == np.uint8 and full.std() > 0
        assert shown.render(ViewOptions(camera, layer), pose, 40, 20, resolution=0.25).shape == (5, 10, 3)


def test_the_error_is_that_of_the_nearest_view_without_masked_pixels(renderer):
    run = renderer.run
    view = run.scene.test[0]
    near = view.cam_from_world.clone()
    near[:3, 3] += 1e-3
    assert renderer.nearest(near).name == view.name
    here = renderer.render(ViewOptions("panorama", "error"), view.cam_from_world, 32, 16)
    assert np.abs(here.astype(int) - renderer.render(ViewOptions("panorama", "error"), near, 32, 16)).max() < 2
    masked = replace(view, load_mask=lambda: torch.zeros(16, 32))
    blind = replace(run, result=None)
    blind.__dict__["scene"] = replace(run.scene, test=(masked,))
    assert RunRenderer(blind).render(ViewOptions("panorama", "error"), view.cam_from_world, 32, 16)[..., 1].max() == 0


def test_cropped_gaussians_are_not_rendered(renderer, anchors):
    for shown in (renderer, anchors):
        view, far = shown.run.scene.train[0], ((1e6,) * 3, (2e6,) * 3)
        assert shown.can_crop
        assert shown.render(ViewOptions("panorama", crop=far), view.cam_from_world, 32, 16).max() == 0
        all_of_it = shown.render(ViewOptions("panorama", crop=((-1e6,) * 3, (1e6,) * 3)), view.cam_from_world, 32, 16)
        assert np.array_equal(all_of_it, shown.render(ViewOptions("panorama"), view.cam_from_world, 32, 16))
        assert shown.run.method.render(view).image.max() > 0, "the run itself is left as it is"


def test_side_by_side():
    found = side_by_side(np.zeros((4, 6, 3), np.uint8), np.full((4, 6, 3), 7, np.uint8))
    assert found.shape == (4, 14, 3) and found[0, 0, 0] == 0 and found[0, 7, 0] == 255 and found[0, 13, 0] == 7
