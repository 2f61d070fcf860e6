"""Synthetic point clouds: on surfaces seen twice, with noise and outliers."""

import numpy as np
import pytest

from padgs.data.synthetic import SyntheticOptions, SyntheticTruth, camera
from padgs.data.synthetic.camera import sample_points


def cloud(**settings):
    options = SyntheticOptions(**({"width": 64, "train_views": 6, "test_views": 0, "points": 3000} | settings))
    truth = SyntheticTruth(options)
    images = [camera.draw(truth.world, pose, 64, 4) for pose in truth.poses]
    return truth, images, *sample_points(truth.world, truth.poses, images, options, truth.random("points"))


def seen_by(truth, pose, points):
    toward = points.T - camera.center(pose)[:, None]
    far = np.linalg.norm(toward, axis=0)
    return truth.world.nearest(camera.center(pose)[:, None], toward / far)[0], far


def test_clean_points_lie_on_surfaces_that_two_cameras_see():
    truth, _, points, colors = cloud(point_noise=0.0, outliers=0.0)
    assert points.shape == colors.shape == (3000, 3)
    assert colors.dtype == np.uint8
    count = np.zeros(len(points), int)
    for pose in truth.poses:
        reached, far = seen_by(truth, pose, points)
        assert (reached <= far + 1e-6).all()  # nothing lies in front of a surface
        count += reached > far - 2e-3
    assert (count >= 2).all()


def test_colours_are_those_of_the_images():
    truth, images, points, colors = cloud(point_noise=0.0, outliers=0.0)
    best = np.full(len(points), 255)
    for pose, image in zip(truth.poses, images, strict=True):
        x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
        u = ((np.arctan2(x, z) / (2 * np.pi) + 0.5) * 64).astype(int) % 64
        v = ((np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * 32).astype(int)
        best = np.minimum(best, np.abs(image[v, u].astype(int) - colors).max(1))
    assert (best <= 0).mean() > 0.99  # each has exactly the colour of the pixel that it was found in


def test_noise_is_relative_to_the_distance():
    clean, noisy = (cloud(point_noise=noise, outliers=0.0) for noise in (0.0, 0.01))
    offset = noisy[2] - clean[2]
    nearest = np.min([seen_by(clean[0], pose, clean[2])[1] for pose in clean[0].poses], axis=0)
    farthest = np.max([seen_by(clean[0], pose, clean[2])[1] for pose in clean[0].poses], axis=0)
    spread = np.sqrt((offset**2).mean())
    assert 0.01 * np.sqrt((nearest**2).mean()) < spread < 0.01 * np.sqrt((farthest**2).mean())


def test_outliers_have_the_given_share():
    truth, _, points, _ = cloud(point_noise=0.0, outliers=0.2)
    assert len(points) == 3000
    off = np.min([np.abs(np.subtract(*seen_by(truth, pose, points))) for pose in truth.poses], axis=0) > 0.01
    assert 0.17 < off.mean() <= 0.2


def test_points_follow_texture():
    """Most of the bare room is blank; its points are on the posters and the edges."""
    truth, _, points, _ = cloud(scene="bare_room", point_noise=0.0, outliers=0.0)
    inner = (np.abs(points[:, 0]) < 2.5) & (np.abs(points[:, 1]) < 2.0) & (points[:, 2] < 0.01)
    floor_area = 5.0 * 4.0 / (30 * 2 + 61.6)
    assert inner.mean() < floor_area / 2
    assert truth.world.sky is None


def test_worlds_without_surfaces_are_refused():
    options = SyntheticOptions(width=16, train_views=2, test_views=0, points=10)
    truth = SyntheticTruth(options)
    truth.world.shapes = ()
    images = [np.zeros((8, 16, 3), np.uint8)] * 2
    with pytest.raises(ValueError, match="no surface point"):
        sample_points(truth.world, truth.poses, images, options, truth.random("points"))
