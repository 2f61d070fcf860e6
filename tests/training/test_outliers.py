"""Weights of pixels that are wrong in one training view and right in nearby views."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from support.tiny_scene import WIDTH, tiny_scene, truth

from padgs.methods.plus.method import PlusMethod, PlusOptions
from padgs.render import RenderOptions, render
from padgs.scene import Scene
from padgs.training.options import Budget, TrainOptions
from padgs.training.outliers import FROM, Outliers
from padgs.training.targets import Target, Targets

ROWS, COLUMNS = slice(6, 10), slice(12, 18)  # where somebody stands in the first view


def with_figure(scene: Scene) -> Scene:
    pixels = scene.train[0].load_pixels().clone()
    pixels[ROWS, COLUMNS] = 255 - pixels[ROWS, COLUMNS]
    return replace(scene, train=(replace(scene.train[0], load_pixels=lambda: pixels), *scene.train[1:]))


def weighted(scene: Scene, ratio: float = 2.0, progress: float = 1.0) -> tuple[Target, Target]:
    """Return the target of the first view, and as it is weighted beside a render of the true Gaussians."""
    targets = Targets(scene.train, "uniform")
    view, target = targets.at(0)
    rendering = render(truth(), view, RenderOptions(), backend="torch")
    return target, Outliers(scene.train, targets, ratio).weighted(0, view, rendering, target, progress)


def test_what_one_view_alone_shows_weighs_less():
    target, found = weighted(with_figure(tiny_scene()))
    assert found.image is target.image
    inside, whole = found.weight[ROWS, COLUMNS].mean(), found.weight.expand(WIDTH // 2, WIDTH)
    assert inside < 0.3 * whole[:, -6:].mean()
    assert whole.max() <= target.weight.max()


def test_views_that_agree_keep_their_weights():
    target, found = weighted(tiny_scene())
    assert (found.weight / target.weight).min() > 0.9


def test_what_every_view_shows_differently_from_the_render_keeps_its_weight():
    scene = tiny_scene()
    views = tuple(replace(view, load_pixels=partial(torch.sub, 255, view.load_pixels())) for view in scene.train)
    target, found = weighted(replace(scene, train=views))
    assert (found.weight / target.weight).median() > 0.9


def test_a_larger_ratio_lowers_fewer_weights_and_the_first_renders_lower_none():
    scene = with_figure(tiny_scene())
    mild, strict = (weighted(scene, ratio)[1].weight.sum() for ratio in (8.0, 1.0))
    assert strict < mild
    target, found = weighted(scene, progress=FROM / 2)
    assert found is target


def test_fewer_than_three_panoramas_are_refused():
    scene = tiny_scene()
    with pytest.raises(ValueError, match="train.outlier_ratio is 2.0, but there are 2 training views"):
        Outliers(scene.train[:2], Targets(scene.train[:2], "uniform"), 2.0)


def test_training_with_it_is_another_training_and_repeatable():
    def trained(ratio: float | None) -> torch.Tensor:
        method = PlusMethod(PlusOptions(), train=TrainOptions(outlier_ratio=ratio), seed=0)
        list(method.fit(with_figure(tiny_scene()), Budget(20)))
        return method.model.splats.means.detach().clone()

    assert not torch.equal(trained(None), trained(2.0))
    assert torch.equal(trained(2.0), trained(2.0))
