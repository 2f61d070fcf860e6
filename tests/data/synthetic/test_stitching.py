"""The simulated dual-fisheye camera: parallax where the lenses meet, none ahead, and the truth for held-out views."""

import numpy as np
import pytest
import torch

from padgs.data import DataError
from padgs.data.synthetic import SyntheticOptions, SyntheticTruth, camera, generate
from padgs.data.synthetic.camera import draw_stitched

SMALL = {"scene": "bare_room", "width": 64, "train_views": 3, "test_views": 1, "points": 200, "samples": 4}


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path))


def test_lenses_in_one_place_draw_what_one_camera_does():
    truth = SyntheticTruth(options := SyntheticOptions(**SMALL))
    stitched = draw_stitched(truth.world, truth.poses[0], 0.0, options, 1.0)
    plain = camera.draw(truth.world, truth.poses[0], 64, 4, 0)
    assert np.abs(stitched.astype(int) - plain).max() <= 1  # bends by 0 in float64, where the plain one has float32


def test_each_half_is_seen_from_its_own_lens():
    options = SyntheticOptions(**SMALL, lens_blend=0.0)
    truth = SyntheticTruth(options)
    stitched = draw_stitched(truth.world, truth.poses[0], 0.2, options, 1.0)
    for sign, columns in ((1, slice(17, 47)), (-1, slice(0, 15))):
        pose = truth.poses[0].copy()
        pose[2, 3] -= sign * 0.1
        alone = camera.draw(truth.world, pose, 64, 4, 0)
        assert np.abs(stitched[:, columns].astype(int) - alone[:, columns]).max() <= 1
        assert np.linalg.norm(camera.center(pose) - camera.center(truth.poses[0])) == pytest.approx(0.1)


def test_lenses_touch_training_views_only():
    plain = generate(SyntheticOptions(**SMALL))
    stitched = generate(SyntheticOptions(**SMALL, lens_gap=0.05, lens_k1=0.02))
    assert (plain.name, stitched.name) == ("synthetic-bare_room", "synthetic-bare_room-two-lenses")
    assert all(torch.equal(a.image(), b.image()) for a, b in zip(plain.test, stitched.test, strict=True))
    for a, b in zip(plain.train, stitched.train, strict=True):
        assert torch.equal(a.cam_from_world, b.cam_from_world)
        assert (a.image() - b.image()).abs().mean() > 0.005


@pytest.mark.parametrize("knobs", [{"lens_gap": -0.1}, {"lens_blend": 90.0}, {"lens_k1": 0.5}])
def test_impossible_lenses_are_refused(knobs):
    with pytest.raises(DataError, match=next(iter(knobs))):
        SyntheticOptions(**SMALL, **knobs)
