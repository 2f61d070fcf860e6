from dataclasses import replace

import pytest
import torch
from tiny_scene import tiny_scene

from padgs.data.camera_paths import PATHS, along_cameras, interpolate_poses, look_along
from padgs.scene import Scene


def centers(poses: torch.Tensor) -> torch.Tensor:
    return -torch.einsum("fji,fj->fi", poses[:, :3, :3], poses[:, :3, 3])


def walk(places: list[list[float]]) -> Scene:
    """Upright cameras, whose up is -y, at places."""
    scene, views = tiny_scene(), []
    for number, place in enumerate(places):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = -torch.tensor(place, dtype=torch.float64)
        views.append(replace(scene.train[0], name=str(number), cam_from_world=pose))
    return replace(scene, train=tuple(views))


@pytest.mark.parametrize("name", PATHS)
def test_poses_are_rigid_and_as_many_as_asked_for(name):
    poses = PATHS[name](tiny_scene(), 7)
    turns = poses[:, :3, :3]
    assert poses.shape == (7, 4, 4) and poses.dtype == torch.float64
    assert torch.allclose(turns @ turns.mT, torch.eye(3, dtype=torch.float64).expand(7, 3, 3), atol=1e-9)
    assert torch.allclose(torch.linalg.det(turns), torch.ones(7, dtype=torch.float64))


def test_the_way_through_the_cameras_is_walked_at_one_speed_and_rounds_corners():
    scene = walk([[0, 0, 0], [1, 0, 0], [4, 0, 0], [4, 0, 2]])
    found = centers(along_cameras(scene, 61))
    steps = (found[1:] - found[:-1]).norm(dim=-1)
    assert torch.allclose(steps[15:25], steps[20].expand(10), rtol=0.05), "however far apart the cameras"
    corner = (found - torch.tensor([4.0, 0, 0], dtype=torch.float64)).norm(dim=-1).min()
    assert 0.05 < corner < 1.0
    with pytest.raises(ValueError, match="use --path orbit or --path dolly"):
        along_cameras(walk([[1, 0, 0]] * 3), 5)
    assert PATHS["dolly"](walk([[1, 0, 0]] * 3), 5).isfinite().all()


def test_cameras_are_passed_in_the_order_of_their_numbers():
    scene = walk([[number, 0, 0] for number in range(12)])
    scene = replace(scene, train=tuple(sorted(scene.train, key=lambda view: view.name)))  # 0, 1, 10, 11, 2, as loaded
    assert centers(along_cameras(scene, 30))[:, 0].diff().min() > 0


def test_between_two_turns_lies_the_half_turn():
    quarter = look_along(torch.zeros(2, 3).numpy(), torch.tensor([[0.0, 0, 1], [1, 0, 0]]).numpy(), [0, -1, 0])
    ahead = interpolate_poses(quarter, [0.5])[0, 2, :3]
    assert torch.allclose(ahead, torch.tensor([0.5**0.5, 0, 0.5**0.5], dtype=torch.float64))


def test_an_orbit_is_a_level_circle_that_looks_inwards():
    scene = walk([[-1, 0, 0], [1, 0, 0], [0, 0, 0.5], [0, 0, -0.5]])
    poses = PATHS["orbit"](scene, 12)
    found = centers(poses)
    assert torch.allclose(found.norm(dim=-1), torch.full((12,), 0.4, dtype=torch.float64))
    assert found[:, 1].abs().max() < 1e-9
    assert torch.allclose(poses[:, 2, :3], -found / 0.4), "z of the camera looks at the middle"
    assert torch.allclose(poses[:, 1, :3], torch.tensor([0.0, 1, 0], dtype=torch.float64).expand(12, 3)), "y is down"


def test_a_dolly_goes_where_the_cameras_are_spread():
    scene = walk([[0, 0, 0], [1, 0.01, 0], [2, 0, 0.1], [4, 0, 0]])
    poses = PATHS["dolly"](scene, 5)
    found = centers(poses)
    assert found[-1, 0] - found[0, 0] == pytest.approx(4, abs=0.05)
    assert poses[0, 2, 0] == pytest.approx(1, abs=0.01)


def test_looking_straight_up_is_a_pose_too():
    poses = look_along(torch.zeros(1, 3).numpy(), torch.tensor([[0.0, -1, 0]]).numpy(), [0.0, -1.0, 0.0])
    assert torch.allclose(torch.linalg.det(poses[:, :3, :3]), torch.ones(1, dtype=torch.float64))
