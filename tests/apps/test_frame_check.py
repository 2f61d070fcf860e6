"""Worlds of files of Gaussians: transforms that users state, and alignment without a data set."""

import json
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from padgs.apps.frame_check import FrameCheck, _closest_points, _worlds, as_numbers, read_transform
from padgs.data.capture import DataError
from padgs.geometry.similarity import Similarity
from padgs.scene import Scene

TURN = torch.from_numpy(Rotation.from_rotvec([0.5, -1.2, 0.3]).as_matrix())
MOVED = Similarity(1.7, TURN, torch.tensor([0.3, -2.0, 5.0], dtype=torch.float64))


def test_a_faulty_file_of_nerfstudio_s_world_is_named(tmp_path):
    file = tmp_path / "dataparser_transforms.json"
    file.write_text(json.dumps({"transform": torch.eye(4)[:3].tolist()}))
    with pytest.raises(ValueError, match="scale") as raised:
        read_transform(str(file))
    assert not isinstance(raised.value, DataError) and "is no file" not in str(raised.value)


def test_points_are_aligned_from_another_scale_and_place(generator):
    points = torch.randn(800, 3, generator=generator, dtype=torch.float64) * torch.tensor([3.0, 2.0, 1.0])
    near = Similarity(1.0, torch.from_numpy(Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix()), torch.zeros(3))
    start = Similarity(0.0, near.rotation @ MOVED.rotation.mT, torch.zeros(3))
    distance, found = _closest_points(points, MOVED(points), start, 800, 60)
    assert distance < 1e-6 and torch.allclose(found(MOVED(points)), points, atol=1e-6)


def test_transforms_are_read_and_combined(tmp_path):
    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = MOVED.scale * MOVED.rotation.numpy(), MOVED.translation.numpy()
    np.save(tmp_path / "a.npy", matrix)
    (tmp_path / "a.json").write_text(json.dumps(matrix.tolist()))
    np.savetxt(tmp_path / "a.txt", matrix)
    lines = (tmp_path / "a.txt").read_text()
    (tmp_path / "bom.txt").write_text(lines, encoding="utf-8-sig")  # Notepad
    (tmp_path / "wide.txt").write_text(lines, encoding="utf-16")  # PowerShell
    (tmp_path / "B.JSON").write_text(json.dumps(matrix.tolist()), encoding="utf-16")
    files = ("a.npy", "a.json", "a.txt", "bom.txt", "wide.txt", "B.JSON")
    for text in (as_numbers(MOVED), *(str(tmp_path / file) for file in files)):
        assert torch.allclose(read_transform(text)(points), MOVED(points), atol=1e-5)
    assert torch.allclose(read_transform("identity")(points), points)
    other = Similarity(translation=torch.tensor([1.0, 2, 3]).double())
    assert torch.allclose((MOVED @ other)(points), MOVED(other(points)))


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("nowhere.json", "is no file and no 12 or 16 numbers"),
        ("1 2 3", "is no file and no 12 or 16 numbers"),
        ("1 0 0 0 0 1 0 0", "has 8 numbers"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0", "is a mirror image"),
        ("1 0 0 0 0 2 0 0 0 0 1 0", "shears, or scales axes differently"),
        ("0 0 0 0 0 0 0 0 0 0 0 0", "shears, or scales axes differently"),
        ("1 0 0 nan 0 1 0 0 0 0 1 0", "must be a rotation times a scale"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1", "the last one 0 0 0 1"),
        (" ".join(["1.0000000000000000"] * 16), "the last one 0 0 0 1"),  # longer than a name of a file may be
    ],
)
def test_other_transforms_are_refused(text, rule):
    with pytest.raises(ValueError, match=rule):
        read_transform(text)


def test_gaussians_in_one_place_are_not_aligned_to_points():
    scene = Scene("", (), (), torch.randn(50, 3), torch.zeros(50, 3), "")
    assert {words for words, _ in _worlds(scene, torch.ones(3, 3), None)} == {"with other axes"}


def test_an_empty_file_is_no_transform(tmp_path):
    (tmp_path / "a.npy").touch()
    with pytest.raises(ValueError, match="is no file and no 12 or 16 numbers"):
        read_transform(str(tmp_path / "a.npy"))


def test_views_of_one_colour_tell_nothing_about_the_world():
    assert str(FrameCheck(math.inf, 0.0)).endswith("so the world of the file cannot be checked")
