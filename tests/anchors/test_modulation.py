"""Distortion degree of directions, and Eq. 15."""

import math

import pytest
import torch

from padgs.anchors.modulation import direction_distortion, modulate, polar_axis
from padgs.sphere.distortion import distortion


def test_distortion_of_a_direction_is_that_of_its_point_in_the_camera(generator):
    points = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation
    directions = torch.nn.functional.normalize(points, dim=-1)
    expected = distortion(points @ rotation.T)
    assert torch.allclose(direction_distortion(directions, polar_axis("camera_y", pose)), expected)
    assert torch.allclose(direction_distortion(directions, polar_axis("world_z", pose)), directions[:, 2] ** 2)


@pytest.mark.parametrize("degrees", [0, 30, 45, 60, 90])
def test_known_latitudes(degrees):
    angle = math.radians(degrees)
    direction = torch.tensor([math.cos(angle), math.sin(angle), 0.0], dtype=torch.float64)
    omega = direction_distortion(direction, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    assert omega.item() == pytest.approx(1 - math.cos(angle) ** 2)


def test_modulation_by_hand():
    opacities = torch.tensor([0.8, 0.8, 0.8])
    omega = torch.tensor([0.0, 0.5, 1.0])
    assert torch.allclose(modulate(opacities, omega, 0.9), torch.tensor([0.8, 0.44, 0.08]))
    assert modulate(opacities, omega, 0.0) is opacities
    assert torch.allclose(modulate(opacities, omega, 1.0, 1 - 1e-4), torch.tensor([0.8, 0.4, 0.8e-4]), atol=1e-7)


def test_unknown_axis_is_named():
    with pytest.raises(ValueError, match="unknown omega_axis 'y'; known: camera_y, world_z"):
        polar_axis("y", torch.eye(4))
