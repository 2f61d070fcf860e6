"""padgs_plus where nobody chose anything for the scene: more time never hurts, and no axis of the world is special."""

import pytest
import torch

from padgs.data.perturb import StressOptions
from padgs.data.synthetic import generate
from padgs.data.synthetic.options import SyntheticOptions
from padgs.evaluation.metrics import ws_psnr
from padgs.methods.plus.method import PlusMethod
from padgs.training.options import Budget

pytestmark = pytest.mark.slow
NOISE = 0.25  # dB: of seeds, and of fitting twelve small views for long
ROOM = {"scene": "room", "width": 96, "train_views": 12, "test_views": 3, "samples": 4, "points": 4000}


def quality(iterations: int, seed: int = 0, stress: StressOptions | None = None, **changes) -> float:
    """Mean WS-PSNR of the test views, in dB."""
    scene = generate(SyntheticOptions(**ROOM, **changes))
    scene = scene if stress is None else stress.apply(scene, 0)
    torch.manual_seed(seed)
    method = PlusMethod(seed=seed)
    list(method.fit(scene, Budget(iterations)))
    marks = [ws_psnr(method.render(view).image.clamp(0, 1), view.image()).item() for view in scene.test]
    return sum(marks) / len(marks)


def test_more_iterations_are_never_worse():
    found = [quality(iterations) for iterations in (30, 60, 120, 250, 500, 1000)]
    assert all(later > sooner - NOISE for sooner, later in zip(found, found[1:], strict=False)), found
    assert found[-1] > found[0] + 2


def test_turned_worlds_and_tilted_cameras_change_nothing():
    changes = ({}, {"stress": StressOptions("world_rotation", 2)}, {"tilt": 20.0})
    plain, turned, tilted = (sum(quality(400, seed, **change) for seed in (0, 1)) / 2 for change in changes)
    assert turned == pytest.approx(plain, abs=0.15)
    assert tilted == pytest.approx(plain, abs=NOISE)  # tilted cameras have other pixels, to train on and to score
