import math

import pytest
import torch

from padgs.data.camera_paths import centers, gravity, median_depth, path_length


def _pose(heading: float, center: tuple[float, float, float], tilt: float = 0.0) -> torch.Tensor:
    """A camera in a z-up world, looking along `heading` in the xy plane, rolled by `tilt` about its view axis."""
    forward = torch.tensor([math.cos(heading), math.sin(heading), 0.0], dtype=torch.float64)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    right = torch.linalg.cross(down, forward)
    rotation = torch.stack((right, down, forward))
    c, s = math.cos(tilt), math.sin(tilt)
    rotation = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64) @ rotation
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ torch.tensor(center, dtype=torch.float64)
    return pose


def test_level_cameras_in_a_z_up_world() -> None:
    found = gravity(torch.stack([_pose(heading, (0, 0, 1.5)) for heading in (0.1, 2.0, 4.5)]))
    assert found.axis == "+z" and found.up == pytest.approx((0, 0, 1))
    assert (found.agreement, found.off_axis, found.tilt) == pytest.approx((1, 0, 0), abs=1e-6)


def test_tilted_cameras() -> None:
    poses = torch.stack(
        [_pose(heading, (0, 0, 0), math.radians(5)) for heading in (0, math.pi / 2, math.pi, -math.pi / 2)]
    )
    found = gravity(poses)
    assert found.axis == "+z" and found.off_axis == pytest.approx(0, abs=1e-5)
    assert found.tilt == pytest.approx(5)


def test_length_and_depth() -> None:
    poses = torch.stack([_pose(0.3, center) for center in ((0, 0, 0), (3, 4, 0), (3, 4, 2))])
    assert torch.allclose(centers(poses), torch.tensor([[0, 0, 0], [3, 4, 0], [3, 4, 2]], dtype=torch.float64))
    assert path_length(poses) == pytest.approx(7)
    assert median_depth(poses[:1], torch.tensor([[1.0, 0, 0], [2, 0, 0], [0, 0, 9]])) == pytest.approx(2)
