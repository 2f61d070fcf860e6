import math

import pytest
import torch

from padgs.geometry.lens import AXES, axis_direction, bend, hemisphere_weight
from padgs.geometry.panorama import rays

K = torch.tensor([0.03, -0.004], dtype=torch.float64)


def angle_from(axis: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    aside = torch.linalg.cross(directions, axis.expand_as(directions)).norm(dim=-1)
    return torch.atan2(aside, directions @ axis)


def radial_map(theta: torch.Tensor, k: torch.Tensor) -> torch.Tensor:
    return theta * (1 + k[0] * theta**2 + k[1] * theta**4)


@pytest.mark.parametrize("name", AXES)
def test_bend_applies_the_radial_map(name):
    axis, directions = axis_direction(name), rays(64, 32, dtype=torch.float64)
    bent = bend(directions, axis, K)
    torch.testing.assert_close(bent.norm(dim=-1), torch.ones(32, 64, dtype=torch.float64))
    theta = angle_from(axis, directions)
    torch.testing.assert_close(angle_from(axis, bent), radial_map(theta, K))
    aside = torch.linalg.cross(directions, axis.expand_as(directions))
    assert (bent * aside).sum(-1).abs().max() < 1e-12, "in the plane of axis and direction"


def test_bend_is_exact_without_coefficients_and_on_the_axis():
    directions, axis = rays(48, 24), axis_direction("z")
    assert torch.equal(bend(directions, axis.float(), torch.zeros(2)), directions)
    assert torch.equal(bend(axis[None], axis, K), axis[None])


def test_radial_map_is_invertible():
    theta = torch.linspace(0, 1.7, 500, dtype=torch.float64)
    bent = radial_map(theta, K)
    assert (bent.diff() > 0).all()
    back = bent.clone()
    for _ in range(60):
        back = back - (radial_map(back, K) - bent)
    torch.testing.assert_close(back, theta)
    axis = axis_direction("y")
    directions = rays(32, 16, dtype=torch.float64)
    there = bend(directions, axis, K)
    found = there.clone()
    for _ in range(80):
        found = torch.nn.functional.normalize(found + (there - bend(found, axis, K)), dim=-1)
    near = angle_from(axis, directions) < 1.7
    torch.testing.assert_close(found[near], directions[near], rtol=0, atol=1e-9)


@pytest.mark.parametrize("blend", [0.0, 0.1, 0.8])
def test_weights_of_two_lenses_sum_to_one(blend):
    axis, directions = axis_direction("x"), rays(64, 32, dtype=torch.float64)
    front, back = hemisphere_weight(directions, axis, blend), hemisphere_weight(directions, -axis, blend)
    torch.testing.assert_close(front + back, torch.ones_like(front))
    assert (front[directions[..., 0] > math.sin(blend)] == 1).all() and (front[..., 32:] >= 0.5).all()


def test_gradient_by_coefficients():
    directions = rays(12, 6, dtype=torch.float64)
    coefficients = K.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda k: bend(directions, axis_direction("z"), k), coefficients)
