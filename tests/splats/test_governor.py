"""Growth by need: errors are those of the pixels that show a Gaussian, and growth ends where it gains too little."""

from dataclasses import replace

import pytest
import torch
from tiny_scene import tiny_scene

from padgs.learning.targets import image_of
from padgs.render import RenderOptions, render
from padgs.splats import governor
from padgs.splats.governor import SEEN, Governor
from padgs.splats.model import Splats

OPTIONS = RenderOptions()


@pytest.fixture
def splats():
    return Splats.from_scene(tiny_scene(), degree=0, generator=torch.Generator().manual_seed(0))


def governed(views=None) -> Governor:
    scene = tiny_scene()
    return Governor(scene.train if views is None else views, scene.test, "torch")


def test_an_error_is_the_mean_over_pixels_by_what_a_gaussian_contributes_to_them(splats):
    view = tiny_scene().train[1]
    found = governed()._errors(splats, view, OPTIONS)
    image = render(splats.gaussians(view), view, OPTIONS, backend="torch").image
    error = (image.clamp(0, 1) - image_of(view)).abs().mean(-1).detach()
    rows = (torch.arange(view.height) + 0.5) / view.height
    weight = torch.sin(rows * torch.pi)[:, None]
    for number in (0, 7, 21):
        alone = splats.gaussians(view)  # all black but one: what is seen is its contribution
        colors = torch.zeros_like(alone.colors).index_fill(0, torch.tensor([number]), 1.0)
        shown = render(replace(alone, colors=colors), view, OPTIONS, backend="torch").image[..., 0].detach() * weight
        assert found[number].item() == pytest.approx((shown * error).sum().item() / shown.sum().item(), rel=1e-3)


def test_an_error_counts_where_two_views_show_it(splats, monkeypatch):
    scene = tiny_scene()
    errors = {scene.train[0].name: torch.tensor([0.0, 1.0, 1.0]), scene.train[1].name: torch.tensor([0.0, 0.0, 1.0])}
    nothing = torch.zeros(3)
    judge = governed()
    monkeypatch.setattr(judge, "_errors", lambda splats, view, options: errors.get(view.name, nothing))
    assert judge.candidates(splats, OPTIONS).tolist() == [False, False, True] and SEEN == 2


@pytest.mark.parametrize(("gained", "goes_on"), [(0.2, True), (0.05, False), (-0.1, False)])
def test_growth_ends_for_good_where_a_doubling_gains_less_than_a_tenth_of_a_decibel(
    splats, monkeypatch, gained, goes_on
):
    values = iter([30.0, 25.0, 30.0 + gained, 40.0])
    monkeypatch.setattr(governor, "quality", lambda render, views: next(values))
    judge = governed()
    monkeypatch.setattr(judge, "_errors", lambda splats, view, options: torch.ones(len(splats)))
    assert judge.candidates(splats, OPTIONS).all() and judge.candidates(splats, OPTIONS).all(), "one dip is nothing"
    twice = {name: torch.cat((rows, rows)) for name, rows in splats.rows().items()}
    splats.load(twice)
    assert judge.candidates(splats, OPTIONS).all().item() == goes_on
    again = governed()
    again.state = dict(judge.state)
    monkeypatch.setattr(again, "_errors", judge._errors)
    assert again.candidates(splats, OPTIONS).all().item() == goes_on, "a resumed run remembers"
