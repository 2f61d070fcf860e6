"""Light maps against the lamps they were made from."""

import numpy as np
import pytest

from padgs.data.synthetic.shapes import Box, Ground, Material, Room
from padgs.data.synthetic.textures import plain
from padgs.data.synthetic.world import Light, World, lambert, sphere_points

SKIN = (Material(plain((0.5, 0.5, 0.5))),)
LIGHT = Light((((0.0, 0.0, 2.0), 1.0),), size=0.1)


def test_without_obstacles_the_map_is_the_lamp():
    ground = World((Ground(SKIN),), LIGHT).light_maps[0, 0]
    uv = np.array([[0.0, 1.5, -3.0], [0.0, 2.0, 4.0]], np.float32)
    direct, openness = ground.at(uv)
    points = np.concatenate((uv, np.zeros((1, 3), np.float32)))
    up = np.array([[0.0], [0.0], [1.0]], np.float32)
    np.testing.assert_allclose(direct, lambert(points, up, np.array((0, 0, 2.0)), 1.0), atol=5e-3)
    assert direct[0] == pytest.approx(1 / 1.5, abs=5e-3)  # straight below: 1 / (1 + 2 / 4)
    np.testing.assert_allclose(openness, 1, atol=1e-6)


def test_a_shadow_lies_opposite_the_lamp_and_has_a_soft_edge():
    """A 1 m plate at half the lamp's height throws a 2 m shadow."""
    plate = Box((0, 0, 1.0), (0.5, 0.5, 0.01), SKIN)
    ground = World((Ground(SKIN), plate), LIGHT).light_maps[0, 0]
    across = np.stack((np.linspace(0, 3, 61), np.zeros(61))).astype(np.float32)
    direct, _ = ground.at(across)
    free = World((Ground(SKIN),), LIGHT).light_maps[0, 0].at(across)[0]
    ratio = direct / free
    assert ratio[:14].max() < 0.01  # x < 0.7
    assert ratio[30:].min() > 0.99  # x > 1.5
    assert abs(np.interp(0.5, ratio, across[0]) - 1.0) < 0.1


def test_corners_are_darker_than_the_middle_of_a_floor():
    room = World((Room((-2, -2, 0), (2, 2, 3), SKIN),), LIGHT)
    openness = room.light_maps[0, 4].at(np.array([[0.0, 1.95, 1.95], [0.0, 0.0, 1.95]], np.float32))[1]
    assert openness[0] > 0.95 > openness[1] + 0.2 > openness[2] + 0.3


def test_sphere_points_are_even():
    points = sphere_points(64)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(points.mean(0), 0, atol=0.02)
    np.testing.assert_allclose(points.T @ points / 64, np.eye(3) / 3, atol=0.02)
