from dataclasses import FrozenInstanceError, fields

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from padgs.gaussians import Gaussians, rotation_matrices

components = st.floats(-3, 3, allow_subnormal=False)
quaternions = st.tuples(components, components, components, components)
HALF = 0.5**0.5


def double(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize(
    ("quaternion", "x_becomes", "y_becomes"),
    [
        ((1, 0, 0, 0), (1, 0, 0), (0, 1, 0)),
        ((HALF, HALF, 0, 0), (1, 0, 0), (0, 0, 1)),  # 90 degrees about x: y -> z
        ((HALF, 0, HALF, 0), (0, 0, -1), (0, 1, 0)),  # about y: x -> -z
        ((HALF, 0, 0, HALF), (0, 1, 0), (-1, 0, 0)),  # about z: x -> y
        ((0, 0, 0, 1), (-1, 0, 0), (0, -1, 0)),  # 180 degrees about z
    ],
)
def test_known_rotations(quaternion, x_becomes, y_becomes):
    matrix = rotation_matrices(double(quaternion))
    torch.testing.assert_close(matrix[:, 0], double(x_becomes), rtol=0, atol=1e-15, check_dtype=False)
    torch.testing.assert_close(matrix[:, 1], double(y_becomes), rtol=0, atol=1e-15, check_dtype=False)


def product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Hamilton product, from i j = k."""
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return torch.cat((scalar[None], a[0] * b[1:] + b[0] * a[1:] + torch.linalg.cross(a[1:], b[1:])))


@given(quaternions, quaternions)
def test_axioms_of_rotations(first, second):
    a, b = double(first), double(second)
    assume(min(a.norm(), b.norm()) > 1e-2)
    matrix = rotation_matrices(a)
    torch.testing.assert_close(matrix @ matrix.T, torch.eye(3).double(), rtol=0, atol=1e-13)
    assert torch.linalg.det(matrix).item() == pytest.approx(1, abs=1e-13)
    torch.testing.assert_close(rotation_matrices(-3 * a), matrix, rtol=0, atol=1e-13)  # sign and length do not count
    composed = rotation_matrices(product(a, b))
    torch.testing.assert_close(composed, matrix @ rotation_matrices(b), rtol=0, atol=1e-12)


def test_rotations_are_batched_and_differentiable(generator):
    quats = torch.randn(2, 5, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    batch = rotation_matrices(quats)
    assert batch.shape == (2, 5, 3, 3)
    torch.testing.assert_close(batch[1, 3], rotation_matrices(quats[1, 3]))
    assert torch.autograd.gradcheck(rotation_matrices, quats[0])


def some(count: int) -> Gaussians:
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 3))
    return Gaussians(*(torch.rand(shape) for shape in shapes))


def test_size_and_conversion():
    gaussians = some(7)
    assert len(gaussians) == 7 and len(some(0)) == 0
    converted = gaussians.to(torch.float64)
    for field in fields(Gaussians):
        tensor = getattr(converted, field.name)
        assert tensor.dtype == torch.float64
        assert torch.equal(tensor.float(), getattr(gaussians, field.name))
    with pytest.raises(FrozenInstanceError):
        gaussians.means = converted.means  # type: ignore[misc]
