import math

import pytest
import torch

from padgs.geometry.distortion import solid_angle_weight
from padgs.geometry.harmonics import basis, dc_from_colors
from padgs.geometry.panorama import rays


def test_orthonormal_on_the_sphere():
    width, height = 128, 64
    values = basis(rays(width, height, dtype=torch.float64), 3)  # [H, W, 16]
    weight = solid_angle_weight(height, dtype=torch.float64)
    area = 4 * math.pi * weight / (width * weight.sum())
    products = torch.einsum("hwa,hwb,h->ab", values, values, area)
    assert (products - torch.eye(16)).abs().max() < 1e-3  # what the sum over pixels misses of the integral


def test_addition_theorem():
    """The squares of one degree sum to (2 l + 1) / 4 pi in every direction."""
    values = basis(rays(16, 8, dtype=torch.float64), 3)
    for degree in range(4):
        total = values[..., degree**2 : (degree + 1) ** 2].square().sum(-1)
        assert torch.allclose(total, torch.full_like(total, (2 * degree + 1) / (4 * math.pi)), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_lower_degrees_come_first(degree):
    directions = rays(8, 4)
    assert torch.equal(basis(directions, degree), basis(directions, 3)[..., : (degree + 1) ** 2])


def test_signs_of_the_file_format():
    """Along +z, +x and +y: the linear terms are ordered y, z, x with signs -, +, -."""
    linear = basis(torch.eye(3), 1)[:, 1:]
    c = math.sqrt(3 / (4 * math.pi))
    assert torch.allclose(linear, c * torch.tensor([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))


def test_every_function_is_its_polynomial_up_to_parity():
    directions = rays(8, 4, dtype=torch.float64)
    forward, backward = basis(directions, 3), basis(-directions, 3)
    parity = torch.tensor([(-1.0) ** degree for degree in range(4) for _ in range(2 * degree + 1)])
    assert torch.allclose(backward, forward * parity, atol=1e-12)


def test_constant_term_reproduces_the_color_and_unknown_degrees_are_refused():
    with pytest.raises(ValueError, match="degree is 4"):
        basis(torch.eye(3), 4)
    colors = torch.tensor([[0.0, 0.5, 1.0]])
    assert torch.allclose(0.5 + basis(torch.tensor([0.0, 1.0, 0.0]), 0) * dc_from_colors(colors), colors)
