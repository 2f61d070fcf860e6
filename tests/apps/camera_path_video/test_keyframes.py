import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from padgs.data.camera_paths import PathError, read_path

UP = (0.0, 0.0, 1.0)


def test_keyframes_look_where_they_say(tmp_path):
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
def test_a_camera_path_of_nerfstudio_comes_back_into_our_world(applied, tmp_path):
    """Ours is that of transforms.json; what was applied to an earlier one is in nerfstudio's transform as well."""
    turn, shift, scale = Rotation.from_rotvec([0.3, 0.2, -0.9]).as_matrix(), np.array([1.0, 2, 3]), 0.25
    ours = np.tile(np.eye(4), (3, 1, 1))  # world_from_cam, y down and z forward
    ours[:, :3, :3] = Rotation.from_rotvec([[0, 0.1 * n, 0.4] for n in range(3)]).as_matrix()
    ours[:, :3, 3] = [[n, 1, -n] for n in range(3)]
    theirs = ours.copy()
    theirs[:, :3, :3] = turn @ ours[:, :3, :3] @ np.diag([1, -1, -1])
    theirs[:, :3, 3] = scale * (ours[:, :3, 3] @ turn.T + shift)
    cameras = [{"camera_to_world": pose.ravel().tolist(), "fov": 75, "aspect": 1} for pose in theirs]
    (tmp_path / "path.json").write_text(json.dumps({"camera_path": cameras, "fps": 24, "seconds": 2}))
    before = np.vstack((applied.get("applied_transform", np.eye(3, 4)), (0, 0, 0, 1)))
    transform = np.column_stack((turn, shift)) @ before
    told = {"transform": transform.tolist(), "scale": scale * applied.get("applied_scale", 1)}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(told))
    (tmp_path / "transforms.json").write_text(json.dumps(applied))
    found = read_path(tmp_path / "path.json", None, UP, tmp_path / "transforms.json")
    assert np.allclose(found.numpy(), np.linalg.inv(ours))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not readable JSON"),
        ("[1]", "is not a camera path"),
        ('{"keyframes": [{"position": [0, 0, 0]}]}', "is not a camera path .KeyError: 'look_at'"),
        ('{"keyframes": [{"position": [0, 0, 0], "look_at": [1, 0, 0]}]}', "has 1 poses; a path needs at least two"),
        (
            '{"keyframes": [{"position": [1, 2, 3], "look_at": [1, 2, 3]}]}',
            "give different positions and a non-zero up",
        ),
        ('{"up": [0, 0, 0], "keyframes": [{"position": [0, 0, 0], "look_at": [1, 0, 0]}]}', "or up is 0"),
        ('{"keyframes": [{"position": [NaN, 0, 0], "look_at": [1, 0, 0]}]}', "is not finite"),
        ('{"camera_path": [{"camera_to_world": [1, 2]}]}', "is not a camera path"),
        ('{"camera_path": [{"camera_to_world": [2,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]}]}', "that is not a rotation"),
    ],
)
def test_what_is_no_path_is_refused(text, message, tmp_path):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(PathError, match=message):
        read_path(tmp_path / "a.json", None, UP)
    with pytest.raises(PathError, match="does not exist; known: cameras, orbit, dolly, or a JSON file"):
        read_path(tmp_path / "orbti", None, UP)
