import math

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from torch.nn.functional import normalize

from padgs.geometry.distortion import (
    distortion,
    distortion_map,
    end_row_weight,
    opacity_factor,
    polar_axis,
    solid_angle_weight,
)
from padgs.geometry.panorama import longitude_latitude, row_latitudes

SIZES = [(64, 32), (2048, 1024), (33, 17), (10, 1)]
coordinates = st.floats(-10, 10, allow_subnormal=False)


def omega(point) -> torch.Tensor:
    """Return the distortion degree of a point in the camera frame."""
    point = torch.as_tensor(point, dtype=torch.float64)
    return distortion(normalize(point, dim=-1), polar_axis("camera_y", torch.eye(4, dtype=torch.float64)))


def test_known_points():
    points = [(0, 0, 3), (-5, 0, 0), (0, -2, 0), (0, 7, 0), (0, 1, 1), (1, 1, 1), (0, 1, -(3**0.5))]
    assert omega(points).tolist() == pytest.approx([0, 0, 1, 1, 0.5, 1 / 3, 0.25], abs=1e-15)  # horizon, poles, 45, 30


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_distortion_map_is_sine_squared_of_latitude_and_one_less_the_squared_weight(width, height):
    expected = torch.sin(row_latitudes(height, dtype=torch.float64)) ** 2
    ours = distortion_map(width, height, dtype=torch.float64)
    torch.testing.assert_close(ours, expected[:, None].expand(height, width), rtol=0, atol=1e-14)
    torch.testing.assert_close(ours[:, 0], 1 - solid_angle_weight(height, dtype=torch.float64) ** 2)  # Eq. 11 and 12


@given(st.tuples(coordinates, coordinates, coordinates), st.floats(1e-3, 1e3))
def test_distortion_does_not_depend_on_distance(point, scale):
    point = torch.tensor(point, dtype=torch.float64)
    assume(point.norm() > 1e-3)
    assert 0 <= omega(point).item() <= 1 + 1e-15
    _, latitude = longitude_latitude(point)
    torch.testing.assert_close(omega(point), torch.sin(latitude) ** 2, rtol=0, atol=1e-13)
    torch.testing.assert_close(omega(point * scale), omega(point), rtol=0, atol=1e-13)


def test_distortion_is_smooth_on_the_polar_axis():
    points = torch.tensor([[0.0, 1.0, 0.0], [0.0, -3.0, 0.0], [1e-9, 1.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    points.requires_grad_()
    omega(points).sum().backward()
    assert points.grad.abs().max() < 1e-8  # both extremes are flat: Omega is 1 at the poles and 0 on the horizon
    assert torch.autograd.gradcheck(omega, points)


def test_polar_axes(generator):
    points = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation
    directions = normalize(points, dim=-1)
    assert torch.allclose(distortion(directions, polar_axis("camera_y", pose)), omega(points @ rotation.T))
    assert torch.allclose(distortion(directions, polar_axis("world_z", pose)), directions[:, 2] ** 2)
    with pytest.raises(ValueError, match="unknown omega_axis 'y'; known: camera_y, world_z"):
        polar_axis("y", pose)


def test_opacity_factor():
    degrees = torch.tensor([0.0, 0.5, 1.0])
    assert torch.allclose(opacity_factor(degrees, 0.9), torch.tensor([1.0, 0.55, 0.1]))
    assert torch.equal(opacity_factor(degrees, 0.0), torch.ones(3))
    assert torch.allclose(opacity_factor(degrees, 1.0, 1 - 1e-4), torch.tensor([1.0, 0.5, 1e-4]), atol=1e-7)


def test_mean_distortion_of_the_sphere_is_a_third():
    # Over the sphere the mean of y^2 is 1/3; the mean over the pixels, which overcount the poles, is 1/2.
    height = 512
    weight, degree = solid_angle_weight(height).double(), distortion_map(1, height)[:, 0].double()
    assert ((degree * weight).sum() / weight.sum()).item() == pytest.approx(1 / 3, abs=1e-5)
    assert degree.mean().item() == pytest.approx(1 / 2, abs=1e-6)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_weight_is_proportional_to_the_solid_angle_of_a_row(width, height):
    edges = (torch.arange(height + 1, dtype=torch.float64) / height - 0.5) * math.pi
    area = torch.sin(edges[1:]) - torch.sin(edges[:-1])  # Eq. 8 integrated over a row
    ratio = solid_angle_weight(height, dtype=torch.float64) / area
    torch.testing.assert_close(ratio, ratio[:1].expand(height), rtol=1e-9, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("height", [1, 2, 17, 4096])
def test_no_row_has_weight_zero(height, dtype):
    weight = solid_angle_weight(height, dtype=dtype)
    assert weight.dtype == dtype and (weight > 0).all() and (weight <= 1).all()
    assert weight[0].item() == pytest.approx(math.sin(math.pi / (2 * height)), rel=2e-3)  # half a row from the pole
    torch.testing.assert_close(weight, weight.flip(0), rtol=1e-3, atol=1e-6)


def test_released_weight_is_zero_in_the_end_rows():
    weight = end_row_weight(9, dtype=torch.float64)
    assert weight[[0, -1]].tolist() == pytest.approx([0, 0], abs=1e-15)
    assert weight[4].item() == pytest.approx(1)
    assert weight[2].item() == pytest.approx(math.sqrt(0.5))
