"""Number of rows that hand-made importance scores require, and the pixels that count in a score."""

import math
from dataclasses import replace

import pytest
import torch
from support.tiny_scene import tiny_scene

from padgs.geometry.camera import perspective
from padgs.methods.splats.importance import (
    MIN_KEPT_SHARE,
    Importance,
    count_for_psnr,
    importance_scores,
    most_important,
)
from padgs.methods.splats.method import SplatOptions
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import Splats
from padgs.render import RenderConfig
from padgs.scene import View


def scored(*changes: float) -> Importance:
    change = torch.tensor(changes, dtype=torch.float64)
    return Importance(change, len(changes))


@pytest.mark.parametrize(
    ("psnr", "count"), [(90.0, 5), (60.0, 4), (40.0, 3), (37.0, 2), (20.5, 2), (19.5, 1), (-10.0, 1)]
)
def test_rows_are_removed_until_their_changes_add_up_to_the_psnr(psnr, count):
    found = scored(1e-4, 1.0, 1e-2, 9e-5, 2e-9)
    assert count_for_psnr(found, psnr) == count
    assert most_important(found, count).tolist() == sorted([1, 2, 0, 3, 4][:count])


def test_a_tenth_stays_even_if_all_rows_replace_each_other():
    assert count_for_psnr(scored(*[0.0] * 1000), 44.0) == MIN_KEPT_SHARE * 1000


def test_views_score_by_their_weight_in_training():
    scene = tiny_scene()
    splats = Splats.from_scene(scene, generator=torch.Generator())
    model = SplatModel(splats, SplatOptions(), RenderConfig("ray"), extent=1.0, iterations=10)
    first, second = scene.train[:2]
    alone = [importance_scores(model, (view,)).change for view in (first, second)]
    both = importance_scores(model, (first, replace(second, share=0.5, sphere_share=0.5))).change
    torch.testing.assert_close(both, (alone[0] + 0.25 * alone[1]) / 1.25)


def test_all_pixels_of_a_perspective_view_weigh_the_same():
    black = torch.zeros(32, 32, 3, dtype=torch.uint8)
    pose, lens = torch.eye(4, dtype=torch.float64), perspective(32, 32, 90.0)
    view = View("cut", pose, 32, 32, load_pixels=lambda: black, lens=lens)
    means = torch.tensor([[0.0, -0.8, 1.0], [0.8, 0.0, 1.0]])
    splats = Splats(means, torch.full((2, 3), math.log(0.1)), torch.ones(2, 3), degree=0)
    config = RenderConfig(projection="ray")
    found = importance_scores(SplatModel(splats, SplatOptions(), config, extent=1.0, iterations=10), (view,))
    assert found.change[0].item() == pytest.approx(found.change[1].item(), rel=1e-3) and found.change[0] > 0
