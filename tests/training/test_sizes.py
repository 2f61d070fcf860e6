from contextlib import nullcontext
from dataclasses import replace
from itertools import islice

import pytest
import torch
from support.pretended_gpu import GPU, pretended_gpu
from support.states import assert_same_but_time
from support.tiny_scene import HEIGHT, WIDTH, tiny_scene, truth

from padgs.geometry.camera import Pinhole
from padgs.methods.plus.method import PlusMethod, PlusOptions
from padgs.render import RenderOptions, render
from padgs.scene import View
from padgs.training import targets as training_targets
from padgs.training.health import FIRST
from padgs.training.options import Budget
from padgs.training.targets import Targets, halved

OPTIONS = PlusOptions()


def made(width: int, height: int) -> View:
    pixels = torch.arange(height * width * 3).reshape(height, width, 3).to(torch.uint8)
    mask = torch.ones(height, width)
    mask[:, : width // 4] = 0
    return View("a", torch.eye(4, dtype=torch.float64), width, height, lambda: pixels, lambda: mask)


def sized(coarse_share: float, *views: View) -> Targets:
    return Targets(views, "uniform", "cpu", coarse_share)


def test_a_pixel_is_the_mean_of_the_four_that_it_covers():
    view = made(16, 8)
    small, image = halved(view), view.image()
    assert (small.width, small.height, small.name) == (8, 4, "a")
    mean = (image[::2, ::2] + image[1::2, ::2] + image[::2, 1::2] + image[1::2, 1::2]) / 4
    torch.testing.assert_close(small.image(), mean, atol=0.51 / 255, rtol=0)
    mask = small.mask()
    assert mask is not None and torch.equal(mask, torch.ones(4, 8).index_fill(1, torch.arange(2), 0))


def test_hidden_pixels_have_no_part_in_small_ones():
    view = made(12, 6)  # three columns are hidden
    white = replace(view, load_pixels=lambda: torch.where(view.mask()[..., None] > 0, view.load_pixels(), 255))
    assert torch.equal(halved(view).mask()[0, :3], torch.tensor([0.0, 0.5, 1.0]))
    assert torch.equal(halved(view).load_pixels()[:, 1:], halved(white).load_pixels()[:, 1:])


def test_pixels_on_a_gpu_may_have_a_mask_on_the_cpu():
    view = made(12, 6)
    with pretended_gpu():
        there = replace(view, load_pixels=lambda: view.load_pixels().to(GPU))
        assert halved(there).load_pixels().device == GPU


def test_a_photograph_at_half_the_size_shows_what_is_rendered_at_half_the_size():
    view = View("a", torch.eye(4, dtype=torch.float64), 256, 128)
    image = render(truth(), view, RenderOptions()).image
    small = halved(replace(view, load_pixels=lambda: (image.clamp(0, 1) * 255).round().to(torch.uint8)))
    drawn = render(truth(), small, RenderOptions()).image
    assert (drawn - small.image()).abs().mean() < 0.01, "nothing is shifted"


def test_sizes_that_are_odd_leave_no_direction_out():
    small = halved(replace(made(10, 5), load_mask=None))
    assert (small.width, small.height) == (5, 2)
    assert small.image().mean() == pytest.approx(made(10, 5).image().mean().item(), abs=0.01)


def test_views_double_until_a_share_of_the_run(monkeypatch):
    monkeypatch.setattr(training_targets, "MIN_WIDTH", 8)
    found = sized(0.4, made(32, 16), made(32, 16))
    widths = [found.at(1, progress)[0].width for progress in (0.01, 0.19, 0.2, 0.21, 0.39, 0.4, 1)]
    assert widths == [8, 8, 16, 16, 16, 32, 32]
    for progress in (0.01, 0.3, 1):
        view, target = found.at(0, progress)
        assert target.image.shape == (view.height, view.width, 3)
    assert sized(0.0, made(32, 16)).at(0, 1e-9)[0].width == 32
    always = sized(1.0, made(32, 16))
    assert [always.at(0, progress)[0].width for progress in (0.4, 0.9, 1.0)] == [8, 16, 32]


def test_small_panoramas_and_perspective_views_keep_their_size():
    assert sized(0.4, made(512, 256)).at(0, 0.01)[0].width == 512
    lens = Pinhole(1024, 512, 500.0, 500.0, 512.0, 256.0)
    assert sized(0.4, replace(made(1024, 512), lens=lens)).at(0, 0.01)[0].width == 1024


def test_padgs_plus_begins_with_small_views_and_resumes_bit_identically(monkeypatch):
    monkeypatch.setattr(training_targets, "MIN_WIDTH", WIDTH // 2)
    method = PlusMethod(OPTIONS)
    whole = method.fit(tiny_scene(), Budget(20))
    drawn = []
    plain = method.model.draw
    monkeypatch.setattr(method.model, "draw", lambda view: drawn.append((view.width, view.height)) or plain(view))
    records = list(whole)
    monitor = method.state().values["monitor"]
    assert monitor["first"] == 6 + FIRST, "losses of small views are no measure for those of large ones"
    assert drawn == [(WIDTH // 2, HEIGHT // 2)] * 5 + [(WIDTH, HEIGHT)] * 15
    stopped = PlusMethod(OPTIONS)
    first = list(islice(stopped.fit(tiny_scene(), Budget(20)), 4))
    resumed = PlusMethod(OPTIONS)
    resumed.load_state(stopped.state())
    rest = list(resumed.fit(tiny_scene(), Budget(20)))
    assert [record.loss for record in (*first, *rest)] == [record.loss for record in records]
    assert_same_but_time(resumed.state(), method.state())


def test_a_rehearsal_measures_views_of_their_own_size(monkeypatch):
    monkeypatch.setattr(training_targets, "MIN_WIDTH", WIDTH // 2)
    method, scene, halvings = PlusMethod(OPTIONS), tiny_scene(), []
    model = method.build_model(scene, 10)
    for train in (scene.train, scene.train[:1]):
        trainer = method.build_trainer(model, replace(scene, train=train), Budget(10), nullcontext)
        halvings.append(trainer._views.halvings(0.01))
    assert halvings == [1, 0]


def test_a_run_that_is_stopped_while_views_are_small_ends_on_large_ones_and_has_not_diverged(monkeypatch):
    monkeypatch.setattr(training_targets, "MIN_WIDTH", WIDTH // 2)
    method, ended = PlusMethod(OPTIONS), 0
    for record in method.fit(tiny_scene(), Budget(100)):
        if record.iteration == 10:
            assert method.state().values["monitor"]["halvings"] == 1
            assert method.request_stop("enough")
            ended = record.iteration
    monitor = method.state().values["monitor"]
    assert monitor["halvings"] == 0 and monitor["first"] == ended + 1 + FIRST
