"""Ray casting of a small analytic world and of the room, and point clouds on surfaces that are seen twice."""

import numpy as np
import pytest

from padgs.data.synthetic import SyntheticOptions, SyntheticTruth, camera
from padgs.data.synthetic.paths import cam_from_world
from padgs.data.synthetic.shapes import Material, Room, Sphere
from padgs.data.synthetic.textures import plain
from padgs.data.synthetic.world import SKY, Light, World


@pytest.fixture(scope="module")
def room():
    return SyntheticTruth(SyntheticOptions(train_views=4, test_views=1))


def test_depth_and_ids_of_a_ball_in_an_empty_room():
    skin = (Material(plain((0.5, 0.5, 0.5))),)
    world = World((Room((-2, -3, 0), (4, 5, 3), skin), Sphere((2, 0, 1), 0.5, skin)), Light((((0, 0, 2.5), 1.0),)))
    depth, object_id = camera.trace(world, cam_from_world(np.array((0.0, 0.0, 1.0)), 0.0), 64)
    assert object_id[16, 32] == 1  # straight ahead, along +x
    half = np.pi / 64  # half a pixel off the axis, across and down: cos = cos^2(half)
    along = 2 * np.cos(half) ** 2
    assert depth[16, 32] == pytest.approx(along - np.sqrt(0.25 - (4 - along**2)), abs=1e-9)
    assert depth[16, 16] == pytest.approx(5 / np.cos(half) ** 2, abs=1e-9)  # a quarter to the left is +y
    assert depth[16, 48] == pytest.approx(3 / np.cos(half) ** 2, abs=1e-9)
    assert depth[0, 0] == pytest.approx(2 / np.cos(half), abs=1e-6)  # the ceiling, half a row off the zenith
    assert depth[31, 0] == pytest.approx(1 / np.cos(half), abs=1e-6)
    # A ball of radius 1/2 at distance 2 covers (1 - cos(asin(1/4))) / 2 of the sphere.
    _, object_id = camera.trace(world, cam_from_world(np.array((0.0, 0.0, 1.0)), 0.0), 512)
    rows = np.cos(((np.arange(256) + 0.5) / 256 - 0.5) * np.pi)[:, None]
    share = ((object_id == 1) * rows).sum() / (rows.sum() * 512)
    assert share == pytest.approx((1 - np.sqrt(15) / 4) / 2, rel=0.01)


def test_rays_without_a_hit_see_the_sky():
    skin = (Material(plain((0.5, 0.5, 0.5))),)
    blue = np.array([[0.0], [0.2], [1.0]], np.float32)
    world = World((Sphere((3, 0, 0), 1, skin),), Light((((0, 0, 9), 1.0),)), sky=lambda d: np.tile(blue, d.shape[1]))
    pose = cam_from_world(np.zeros(3), 0.0)
    depth, object_id = camera.trace(world, pose, 32)
    assert np.isinf(depth[object_id == SKY]).all()
    image = camera.draw(world, pose, 32, 4)
    assert (image[8, 0] == (0, 51, 255)).all()  # behind the camera


@pytest.mark.parametrize("shift", [1, 40, 127])
def test_rotating_by_whole_pixels_shifts_the_image(room, shift):
    """Longitude grows to the right, headings to the left: turning left by one pixel moves the image right by one."""
    pose, width = room.poses[2], 256
    rotation = 2 * np.pi * shift / width
    c, s = np.cos(rotation), np.sin(rotation)
    about_down = np.array(((c, 0, s, 0), (0, 1, 0, 0), (-s, 0, c, 0), (0, 0, 0, 1)))
    straight, rotated = (camera.draw(room.world, p, width, 4).astype(int) for p in (pose, about_down @ pose))
    difference = np.abs(np.roll(straight, shift, axis=1) - rotated).max(-1)
    # Rounding moves a ray across the edge of a texture now and then.
    assert (difference > 1).mean() < 0.003


def test_the_seam_is_continuous(room):
    """Mean over views, rows weighted by area: the step across the seam is an ordinary step."""
    weight = np.cos(((np.arange(64) + 0.5) / 64 - 0.5) * np.pi)[:, None]
    steps = []
    for pose in room.poses:
        image = camera.draw(room.world, pose, 128, 16).astype(float)
        steps.append((np.abs(image - np.roll(image, 1, axis=1)).mean(-1) * weight).sum(0))
    step = np.mean(steps, axis=0)
    assert step[0] < 2 * np.median(step[1:])


def test_more_samples_converge(room):
    pose = room.poses[1]
    exact = camera.draw(room.world, pose, 64, 256).astype(float)
    error = [np.sqrt(((camera.draw(room.world, pose, 64, n) - exact) ** 2).mean()) for n in (1, 4, 16)]
    assert all(after < 0.55 * before for before, after in zip(error, error[1:], strict=False))
    assert error[2] < 7  # of 255; at 64 x 32 a pixel holds whole patterns


def test_rendering_does_not_depend_on_threads(room, monkeypatch):
    several = camera.draw(room.world, room.poses[0], 128, 4)
    monkeypatch.setattr(camera, "cores", lambda: 1)
    np.testing.assert_array_equal(camera.draw(room.world, room.poses[0], 128, 4), several)


def test_views_agree_on_common_surfaces(room):
    """A surface point that another camera sees at the distance it should has the same colour there."""
    first, second = room.poses[1], room.poses[2]
    width = 128
    depth, _ = camera.trace(room.world, first, width)
    rows, columns = np.indices(depth.shape) + 0.5
    rays = first[:3, :3].T @ camera.directions(rows.ravel(), columns.ravel(), width, width // 2)
    points = camera.center(first)[:, None] + depth.ravel() * rays
    toward = points - camera.center(second)[:, None]
    far = np.linalg.norm(toward, axis=0)
    reached, _ = room.world.nearest(camera.center(second)[:, None], toward / far)
    assert (reached < far + 1e-6).all()  # nothing is seen through
    both = reached > far - 1e-6
    assert 0.5 < both.mean() < 1
    colors = []
    for pose, direction in ((first, rays), (second, toward / far)):
        origin = camera.center(pose)[:, None].astype(np.float32)
        colors.append(room.world.color(origin, direction[:, both].astype(np.float32)))
    difference = np.abs(colors[0] - colors[1]).max(0)
    assert np.median(difference) < 1e-4
    assert (difference > 0.02).mean() < 0.01  # at edges within the texture


def test_culling_does_not_change_colours(room):
    """Colours with the shapes that a bundle can hit equal those with all shapes tried."""
    pose, world = room.poses[3], room.world
    rows, columns = np.indices((24, 24))
    rays = camera.directions((rows + 8.5).ravel(), (columns + 90.5).ravel(), 128, 64).astype(np.float32)
    direction = pose[:3, :3].T.astype(np.float32) @ rays
    origin = camera.center(pose)[:, None].astype(np.float32)
    everything = list(range(len(world.shapes)))
    np.testing.assert_array_equal(world.color(origin, direction), world.color(origin, direction, everything))


def cloud(**settings):
    options = SyntheticOptions(**({"width": 64, "train_views": 6, "test_views": 0, "points": 3000} | settings))
    truth = SyntheticTruth(options)
    images = [camera.draw(truth.world, pose, 64, 4) for pose in truth.poses]
    return truth, images, *camera.sample_points(truth.world, truth.poses, images, options, truth.random("points"))


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
    _, _, points, _ = cloud(scene="bare_room", point_noise=0.0, outliers=0.0)
    inner = (np.abs(points[:, 0]) < 2.5) & (np.abs(points[:, 1]) < 2.0) & (points[:, 2] < 0.01)
    floor_area = 5.0 * 4.0 / (30 * 2 + 61.6)
    assert inner.mean() < floor_area / 2


def test_worlds_without_surfaces_are_refused():
    options = SyntheticOptions(width=16, train_views=2, test_views=0, points=10)
    truth = SyntheticTruth(options)
    truth.world.shapes = ()
    images = [np.zeros((8, 16, 3), np.uint8)] * 2
    with pytest.raises(ValueError, match="no surface point"):
        camera.sample_points(truth.world, truth.poses, images, options, truth.random("points"))
