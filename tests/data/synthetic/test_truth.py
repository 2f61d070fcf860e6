"""Ground truth of synthetic scenes under every option that changes the training data."""

import math

import numpy as np
import pytest
import torch

from padgs.data.synthetic import SyntheticOptions, SyntheticTruth, generate
from padgs.data.synthetic.camera import center, draw, draw_stitched
from padgs.scene import View

SMALL = {"scene": "bare_room", "width": 64, "train_views": 4, "test_views": 2, "points": 300, "samples": 4}


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path))


def test_world_scale_changes_no_pixel():
    plain, scaled = SyntheticOptions(**SMALL), SyntheticOptions(**SMALL, world_scale=100.0)
    scene, other = generate(plain), generate(scaled)
    truth, large = SyntheticTruth(plain), SyntheticTruth(scaled)
    for view, far in zip((*scene.train, *scene.test), (*other.train, *other.test), strict=True):
        assert torch.equal(view.image(), far.image())
        torch.testing.assert_close(far.center, 100 * view.center)
        torch.testing.assert_close(large.depth(far), 100 * truth.depth(view), rtol=1e-9, atol=0)
    torch.testing.assert_close(other.points, 100 * scene.points)
    assert other.scale == pytest.approx(100 * scene.scale, rel=1e-5)


@pytest.mark.parametrize("scene", ["bare_room", "room_chain"])  # the second has a route of its own
def test_paths_have_the_given_radius(scene):
    poses = SyntheticTruth(
        SyntheticOptions(**SMALL | {"scene": scene, "path": "cross", "path_radius": 0.5, "train_views": 40})
    ).poses
    middle = poses[:, :3, :3].transpose(0, 2, 1) @ -poses[:, :3, 3:]
    across = middle[:, :2, 0].max(0) - middle[:, :2, 0].min(0)
    assert across == pytest.approx([1.0, 1.0], rel=0.05)


def test_pose_noise_affects_training_poses_only():
    options = SyntheticOptions(
        **(SMALL | {"width": 16, "train_views": 40}), pose_noise_translation=0.01, pose_noise_rotation=0.5
    )
    truth = SyntheticTruth(options)
    scene = generate(options)
    clean = generate(SyntheticOptions(**(SMALL | {"width": 16, "train_views": 40})))
    shifts, angles = [], []
    for view, exact in zip(scene.train, clean.train, strict=True):
        assert torch.equal(view.image(), exact.image())
        torch.testing.assert_close(truth.exact_pose(view.name), exact.cam_from_world)
        shifts.append((view.center - exact.center).numpy())
        turn = view.cam_from_world[:3, :3] @ exact.cam_from_world[:3, :3].T
        angles.append(math.degrees(math.acos(min(1.0, (turn.trace().item() - 1) / 2))))
        torch.testing.assert_close(truth.depth(view), truth.depth(exact))  # depth belongs to the image
    assert np.std(shifts) == pytest.approx(0.01 * truth.median_depth, rel=0.2)
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(0.5, rel=0.3)
    for view, exact in zip(scene.test, clean.test, strict=True):
        assert torch.equal(view.cam_from_world, exact.cam_from_world)


def test_truth_renders_any_pose():
    truth = SyntheticTruth(SyntheticOptions(**SMALL, world_scale=10.0))
    pose = truth.exact_pose("001").clone()
    pose[:3, 3] -= pose[:3, :3] @ torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)  # up by 0.2 m
    nearer = truth.depth(View("001", pose, 64, 32))[0].min()
    assert truth.depth(View("001", truth.exact_pose("001"), 64, 32))[0].min() - nearer == pytest.approx(2.0, abs=0.02)


def test_options_do_not_change_unrelated_data():
    base, denser = generate(SyntheticOptions(**SMALL)), generate(SyntheticOptions(**(SMALL | {"points": 500})))
    for view, same in zip(base.train, denser.train, strict=True):
        assert torch.equal(view.image(), same.image())
        assert torch.equal(view.cam_from_world, same.cam_from_world)
    assert len(denser.points) == 500


def test_unknown_view():
    with pytest.raises(ValueError, match="unknown view 'x'; known: 000 to 005"):
        SyntheticTruth(SyntheticOptions(**SMALL)).exact_pose("x")


def test_lenses_without_a_gap_equal_one_camera():
    truth = SyntheticTruth(options := SyntheticOptions(**SMALL))
    stitched = draw_stitched(truth.world, truth.poses[0], 0.0, options)
    plain = draw(truth.world, truth.poses[0], 64, 4, 0)
    assert np.abs(stitched.astype(int) - plain).max() <= 1  # bends by 0 in float64, where the plain one has float32


def test_each_half_is_rendered_from_its_lens():
    options = SyntheticOptions(**SMALL, lens_blend=0.0)
    truth = SyntheticTruth(options)
    stitched = draw_stitched(truth.world, truth.poses[0], 0.2, options)
    for sign, columns in ((1, slice(17, 47)), (-1, slice(0, 15))):
        pose = truth.poses[0].copy()
        pose[2, 3] -= sign * 0.1
        alone = draw(truth.world, pose, 64, 4, 0)
        assert np.abs(stitched[:, columns].astype(int) - alone[:, columns]).max() <= 1
        assert np.linalg.norm(center(pose) - center(truth.poses[0])) == pytest.approx(0.1)


def test_lenses_affect_training_views_only():
    plain = generate(SyntheticOptions(**SMALL))
    stitched = generate(SyntheticOptions(**SMALL, lens_gap=0.05, lens_k1=0.02))
    assert (plain.name, stitched.name) == ("synthetic-bare_room", "synthetic-bare_room-two-lenses")
    assert all(torch.equal(a.image(), b.image()) for a, b in zip(plain.test, stitched.test, strict=True))
    for a, b in zip(plain.train, stitched.train, strict=True):
        assert torch.equal(a.cam_from_world, b.cam_from_world)
        assert (a.image() - b.image()).abs().mean() > 0.005


def test_a_figure_walks_through_training_views_only_and_is_not_in_the_depth():
    plain, walked = generate(SyntheticOptions(**SMALL)), generate(options := SyntheticOptions(**SMALL, figure=True))
    assert walked.name == "synthetic-bare_room-figure"
    assert all(torch.equal(a.image(), b.image()) for a, b in zip(plain.test, walked.test, strict=True))
    places = [SyntheticTruth(options).world_seen(k).shapes[-6].start[:2] for k in (0, 2, 3)]  # of the body
    assert len(set(places)) == 3
    for a, b in zip(plain.train, walked.train, strict=True):
        changed = (a.image() != b.image()).any(-1)
        assert 0.002 < changed.float().mean() < 0.15
        assert (changed.float().mean(1) > 0.5).sum() == 0 and torch.equal(a.load_depth(), b.load_depth())
