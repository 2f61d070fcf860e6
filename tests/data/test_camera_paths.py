"""Camera paths: statistics of poses, built-in paths, and path files."""

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.tiny_scene import tiny_scene

from padgs.data.camera_paths import (
    PATHS,
    along_cameras,
    centers,
    gravity,
    interpolate_poses,
    look_along,
    path_length,
)
from padgs.data.capture import DataError
from padgs.data.formats.path_file import read_path
from padgs.scene import Scene


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


def test_path_length() -> None:
    poses = torch.stack([_pose(0.3, center) for center in ((0, 0, 0), (3, 4, 0), (3, 4, 2))])
    assert torch.allclose(centers(poses), torch.tensor([[0, 0, 0], [3, 4, 0], [3, 4, 2]], dtype=torch.float64))
    assert path_length(poses) == pytest.approx(7)


def walk(places: list[list[float]]) -> Scene:
    """Upright cameras, whose up is -y, at places."""
    scene, views = tiny_scene(), []
    for number, place in enumerate(places):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = -torch.tensor(place, dtype=torch.float64)
        views.append(replace(scene.train[0], name=str(number), cam_from_world=pose))
    return replace(scene, train=tuple(views))


@pytest.mark.parametrize("name", PATHS)
def test_poses_are_rigid_and_have_the_given_count(name):
    poses = PATHS[name](tiny_scene(), 7)
    turns = poses[:, :3, :3]
    assert poses.shape == (7, 4, 4) and poses.dtype == torch.float64
    assert torch.allclose(turns @ turns.mT, torch.eye(3, dtype=torch.float64).expand(7, 3, 3), atol=1e-9)
    assert torch.allclose(torch.linalg.det(turns), torch.ones(7, dtype=torch.float64))


def test_the_camera_path_has_constant_speed_and_rounds_corners():
    scene = walk([[0, 0, 0], [1, 0, 0], [4, 0, 0], [4, 0, 2]])
    found = centers(along_cameras(scene, 61))
    steps = (found[1:] - found[:-1]).norm(dim=-1)
    assert torch.allclose(steps[15:25], steps[20].expand(10), rtol=0.05), "however far apart the cameras"
    corner = (found - torch.tensor([4.0, 0, 0], dtype=torch.float64)).norm(dim=-1).min()
    assert 0.05 < corner < 1.0
    with pytest.raises(ValueError, match="use --path orbit or dolly"):
        along_cameras(walk([[1, 0, 0]] * 3), 5)
    assert PATHS["dolly"](walk([[1, 0, 0]] * 3), 5).isfinite().all()


def test_cameras_are_sorted_naturally():
    scene = walk([[number, 0, 0] for number in range(12)])
    scene = replace(scene, train=tuple(sorted(scene.train, key=lambda view: view.name)))  # 0, 1, 10, 11, 2, as loaded
    assert centers(along_cameras(scene, 30))[:, 0].diff().min() > 0


def test_rotations_are_interpolated_spherically():
    quarter = look_along(torch.zeros(2, 3).numpy(), torch.tensor([[0.0, 0, 1], [1, 0, 0]]).numpy(), [0, -1, 0])
    ahead = interpolate_poses(quarter, [0.5])[0, 2, :3]
    assert torch.allclose(ahead, torch.tensor([0.5**0.5, 0, 0.5**0.5], dtype=torch.float64))


def test_an_orbit_is_a_level_circle_looking_inwards():
    scene = walk([[-1, 0, 0], [1, 0, 0], [0, 0, 0.5], [0, 0, -0.5]])
    poses = PATHS["orbit"](scene, 12)
    found = centers(poses)
    assert torch.allclose(found.norm(dim=-1), torch.full((12,), 0.4, dtype=torch.float64))
    assert found[:, 1].abs().max() < 1e-9
    assert torch.allclose(poses[:, 2, :3], -found / 0.4), "z of the camera looks at the middle"
    assert torch.allclose(poses[:, 1, :3], torch.tensor([0.0, 1, 0], dtype=torch.float64).expand(12, 3)), "y is down"


def test_a_dolly_follows_the_widest_extent():
    scene = walk([[0, 0, 0], [1, 0.01, 0], [2, 0, 0.1], [4, 0, 0]])
    poses = PATHS["dolly"](scene, 5)
    found = centers(poses)
    assert found[-1, 0] - found[0, 0] == pytest.approx(4, abs=0.05)
    assert poses[0, 2, 0] == pytest.approx(1, abs=0.01)


def test_looking_straight_up_gives_a_valid_pose():
    poses = look_along(torch.zeros(1, 3).numpy(), torch.tensor([[0.0, -1, 0]]).numpy(), [0.0, -1.0, 0.0])
    assert torch.allclose(torch.linalg.det(poses[:, :3, :3]), torch.ones(1, dtype=torch.float64))


UP = (0.0, 0.0, 1.0)


def test_keyframes_are_a_second_apart_at_any_rate(tmp_path):
    keys = [{"position": [n, 0, 0], "look_at": [n, 0, 1]} for n in range(3)]
    (tmp_path / "a.json").write_text(json.dumps({"keyframes": keys}))
    assert [len(read_path(tmp_path / "a.json", None, UP, fps=fps)) for fps in (30, 60, 10)] == [60, 120, 20]


def test_keyframes_are_interpolated(tmp_path):
    keys = [{"position": [0, 0, 0], "look_at": [5, 0, 0]}, {"position": [2, 0, 0], "look_at": [2, 3, 0]}]
    (tmp_path / "a.json").write_text(json.dumps({"keyframes": keys}))
    poses = read_path(tmp_path / "a.json", 5, UP)
    assert poses.shape == (5, 4, 4)
    assert torch.allclose(poses[0, :3, :3], torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64))
    center = -poses[2, :3, :3].T @ poses[2, :3, 3]
    assert torch.allclose(center, torch.tensor([1.0, 0, 0], dtype=torch.float64))
    assert len(read_path(tmp_path / "a.json", None, UP)) == 30
    given = {"keyframes": [{"cam_from_world": pose.tolist()} for pose in poses]}
    (tmp_path / "b.json").write_text(json.dumps(given))
    assert torch.allclose(read_path(tmp_path / "b.json", 5, UP), poses)


APPLIED = {"applied_transform": [[1, 0, 0, 0.5], [0, 0, 1, -2], [0, -1, 0, 3]], "applied_scale": 2.0}


@pytest.mark.parametrize("applied", [{}, APPLIED])
def test_nerfstudio_paths_are_converted_to_the_scene(applied, tmp_path):
    """Ours is that of transforms.json; what was applied to an earlier one is in nerfstudio's transform as well."""
    rotation, shift, scale = Rotation.from_rotvec([0.3, 0.2, -0.9]).as_matrix(), np.array([1.0, 2, 3]), 0.25
    ours = np.tile(np.eye(4), (3, 1, 1))  # world_from_cam, y down and z forward
    ours[:, :3, :3] = Rotation.from_rotvec([[0, 0.1 * n, 0.4] for n in range(3)]).as_matrix()
    ours[:, :3, 3] = [[n, 1, -n] for n in range(3)]
    theirs = ours.copy()
    theirs[:, :3, :3] = rotation @ ours[:, :3, :3] @ np.diag([1, -1, -1])
    theirs[:, :3, 3] = scale * (ours[:, :3, 3] @ rotation.T + shift)
    cameras = [{"camera_to_world": pose.ravel().tolist(), "fov": 75, "aspect": 1} for pose in theirs]
    (tmp_path / "path.json").write_text(json.dumps({"camera_path": cameras, "fps": 24, "seconds": 0.1}))
    before = np.vstack((applied.get("applied_transform", np.eye(3, 4)), (0, 0, 0, 1)))
    transform = np.column_stack((rotation, shift)) @ before
    normalized = {"transform": transform.tolist(), "scale": scale * applied.get("applied_scale", 1)}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(normalized))
    (tmp_path / "transforms.json").write_text(json.dumps(applied))
    with pytest.warns(UserWarning, match="the fields of view of the camera path are not used; set --camera and --fov"):
        found = read_path(tmp_path / "path.json", None, UP, tmp_path / "transforms.json")
    for camera in cameras:
        del camera["fov"]
    (tmp_path / "path.json").write_text(json.dumps({"camera_path": cameras, "fps": 24, "seconds": 0.1}))
    assert np.allclose(found.numpy(), np.linalg.inv(ours)), "0.1 s have three frames at 30 a second"
    assert len(read_path(tmp_path / "path.json", None, UP, tmp_path / "transforms.json", fps=120)) == 12
    (tmp_path / "dataparser_transforms.json").unlink()
    with pytest.warns(UserWarning, match="there is no dataparser_transforms.json beside the camera path"):
        assert not np.allclose(read_path(tmp_path / "path.json", None, UP).numpy(), np.linalg.inv(ours))


KEY = '{"position": [0, 0, 0], "look_at": [1, 0, 0]}'
ROWS = "[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not valid JSON"),
        ("[" * 100_000, "is not valid JSON"),
        ("", "is empty"),
        ("[1]", "must be an object, not list"),
        ("{}", "lacks the field 'keyframes'"),
        ('{"keyframes": [{"position": [0, 0, 0]}]}', "entry 0 of keyframes of .* lacks the field 'look_at'"),
        (f'{{"keyframes": [{KEY}]}}', "has 1 poses; a path needs at least two"),
        ('{"keyframes": [{"position": [1, 2, 3], "look_at": [1, 2, 3]}]}', "give different ones"),
        (f'{{"up": [0, 0, 0], "keyframes": [{KEY}]}}', "up is 0; give a direction"),
        (f'{{"up": "z", "keyframes": [{KEY}]}}', "up of .* is not an array of numbers"),
        (KEY.join(('{"keyframes": [', "]}")).replace("1", "NaN"), "is not finite"),
        (KEY.join(('{"keyframes": [', "]}")).replace("1", '"1"'), "look_at of .* is not an array of numbers"),
        (KEY.join(('{"keyframes": [', "]}")).replace("1", "true"), "look_at of .* is not an array of numbers"),
        (f'{{"keyframes": [{{"cam_from_world": [{ROWS}, [0, 0, 0, 2]]}}]}}', "last row .* must be 0 0 0 1"),
        (f'{{"keyframes": [{{"cam_from_world": [{ROWS}]}}]}}', "has 1 poses; a path needs at least two"),
        ('{"keyframes": [{"cam_from_world": [[1, 0, 0]]}]}', r"shape \[1, 3\]; it must be 4x4"),
        ('{"keyframes": [{"position": [0, 0, 0], "look_at": [1e-200, 0, 0]}]}', "position and look_at are both"),
        (KEY.join(('{"up": [0, 1e-320, 0], "keyframes": [', "]}")), "up is 0; give a direction"),
        (", ".join([KEY] * 4000).join(('{"keyframes": [', "]}")), "gives 119970 frames; a video has at most 100000"),
        (KEY.join(('{"keyframes": [', "]}")).replace("1", "1e300"), "is not finite, or beyond 1e"),
        ('{"camera_path": [{"camera_to_world": [1, 2]}]}', "has 2 numbers; a pose has 16"),
        ('{"camera_path": [{"camera_to_world": [2,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]}]}', "is not a rotation"),
        ('{"camera_path": [{"camera_to_world": [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,2]}]}', "must be 0 0 0 1"),
    ],
)
@pytest.mark.filterwarnings("ignore:there is no dataparser")
def test_invalid_path_files_are_refused(text, message, tmp_path):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(DataError, match=message):
        read_path(tmp_path / "a.json", None, UP)
    with pytest.raises(DataError, match="does not exist; known: cameras, orbit, dolly, or a JSON file"):
        read_path(tmp_path / "orbti", None, UP)
    os.mkfifo(tmp_path / "pipe")
    for special in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(DataError, match="it is no regular file"):
            read_path(special, None, UP)
