"""Synthetic camera paths: equal steps, rigid poses, evenly spread test views."""

import numpy as np
import pytest

from padgs.data.synthetic.options import PATHS, SyntheticOptions
from padgs.data.synthetic.paths import Walk, cam_from_world, curve, held_out, poses, stations

WALK = Walk((1.0, -2.0), (2.0, 1.0), height=1.5, sway=0.1)


@pytest.mark.parametrize("kind", PATHS)
def test_stations_stay_inside_and_keep_equal_distances(kind):
    path = curve(WALK, kind, np.random.default_rng(0))
    positions, _ = stations(path, 40)
    assert (np.abs(positions[:, :2] - WALK.center) <= np.array(WALK.half) * 1.001).all()
    assert np.abs(positions[:, 2] - 1.5).max() <= 0.1 + 1e-9
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    usual = np.median(steps)
    assert (np.abs(steps / usual - 1) < 0.35).sum() >= 38  # the cross jumps once, corners are cut
    assert (steps < 0.1 * usual).sum() == 0


def test_a_route_passes_through_its_waypoints():
    waypoints = ((0.0, 0.0), (2.0, 1.0), (3.0, -1.0), (1.0, -2.0))
    path = curve(Walk((0, 0), (1, 1), waypoints=waypoints), "roaming", np.random.default_rng(0))
    for waypoint in waypoints:
        assert np.linalg.norm(path[:, :2] - waypoint, axis=1).min() < 1e-9


def test_camera_axes():
    """Heading 90 degrees looks along +y with x to the right; the image's down is the world's -z."""
    pose = cam_from_world(np.array((1.0, 2.0, 3.0)), np.pi / 2)
    for world, camera in (((1, 5, 3), (0, 0, 3)), ((2, 2, 3), (1, 0, 0)), ((1, 2, 2), (0, 1, 0))):
        np.testing.assert_allclose((pose @ (*world, 1))[:3], camera, atol=1e-12)


@pytest.mark.parametrize("heading", ["path", "fixed", "random"])
def test_poses_are_rigid(heading):
    options = SyntheticOptions(heading=heading, tilt=5.0, train_views=9, test_views=3)
    path = curve(WALK, "roaming", np.random.default_rng(0))
    for pose in poses(options, path, np.random.default_rng(1)):
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


def test_heading_path_looks_along_the_path():
    options = SyntheticOptions(train_views=40, test_views=0)
    path = curve(WALK, "line", np.random.default_rng(0))
    along = poses(options, path, np.random.default_rng(1))
    centers = -np.einsum("nji,nj->ni", along[:, :3, :3], along[:, :3, 3])
    ahead = np.einsum("nij,nj->ni", along[:-1, :3, :3], np.diff(centers, axis=0))
    assert (ahead[:, 2] > 0.9 * np.linalg.norm(ahead, axis=1)).all()  # the next camera is straight ahead


@pytest.mark.parametrize(("train", "test"), [(24, 6), (2, 0), (5, 1), (4, 4)])
def test_held_out_views_are_spread(train, test):
    indices = held_out(SyntheticOptions(train_views=train, test_views=test))
    assert len(set(indices)) == test
    assert all(0 < index < train + test - 1 for index in indices) or train == 4
