import math

import pytest
import torch
from torch.nn.functional import normalize

from padgs.methods.egonerf.field import EnvironmentMap

HEIGHT = 6


@pytest.fixture
def environment() -> EnvironmentMap:
    torch.manual_seed(1)
    return EnvironmentMap(HEIGHT).double()


def towards(z: torch.Tensor, azimuth: torch.Tensor) -> torch.Tensor:
    across = torch.sqrt(1 - z * z)
    return torch.stack((across * torch.cos(azimuth), across * torch.sin(azimuth), z), dim=-1)


def test_a_direction_through_the_centre_of_a_texel_sees_it_alone(environment):
    row, column = (part.flatten() for part in torch.meshgrid(torch.arange(6), torch.arange(12), indexing="ij"))
    z = (2 * row.double() + 1) / HEIGHT - 1
    seen = environment(towards(z, ((2 * column.double() + 1) / (2 * HEIGHT) - 1) * math.pi))
    assert torch.allclose(seen, torch.sigmoid(environment.emission[:, row, column].T))


def test_all_texels_count_for_the_same_solid_angle(environment, generator):
    """Each texel's share in random directions, as the gradient of their sum tells it (before the sigmoid)."""
    count = 200_000
    directions = normalize(torch.randn(count, 3, dtype=torch.float64, generator=generator), dim=-1)
    with torch.no_grad():
        environment.emission.zero_()  # the sigmoid has slope 1/4 everywhere
    environment(directions).sum().backward()
    share = environment.emission.grad * 4 / count * (2 * HEIGHT**2)
    assert share.sum().item() / (2 * HEIGHT**2 * 3) == pytest.approx(1)
    assert (share - 1).abs().max() < 0.08  # 4 standard deviations of the sampling


def test_nothing_jumps_at_180_degrees(environment):
    z = torch.linspace(-0.99, 0.99, 50, dtype=torch.float64)
    left, right = (environment(towards(z, torch.full_like(z, side * (math.pi - 1e-9)))) for side in (-1, 1))
    assert torch.allclose(left, right, atol=1e-7)


def test_poles_are_finite(environment):
    seen = environment(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64))
    assert ((seen > 0) & (seen < 1)).all()
