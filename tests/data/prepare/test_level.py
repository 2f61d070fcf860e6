"""A world whose +z is up."""

import pytest
import torch

from padgs.data.prepare.pipeline import rotation_between


def test_rotation_between_is_the_smallest_turn_to_z():
    for vector in ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.6, 0.0, 0.8), (-0.48, 0.64, -0.6)):
        up = torch.tensor(vector, dtype=torch.float64)
        rotation = rotation_between(up)
        torch.testing.assert_close(rotation @ up, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64))
        assert torch.linalg.det(rotation).item() == pytest.approx(1.0)
        assert (rotation.trace().item() - 1) / 2 == pytest.approx(vector[2], abs=1e-9)  # cosine of its angle
