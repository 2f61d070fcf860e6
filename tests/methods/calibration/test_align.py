"""Alignment of pose sets: recovers a known similarity, and measures what it cannot explain."""

import math

import pytest
import torch

from padgs.data.camera_paths import centers
from padgs.data.formats.poses import rigid, rotation_from_vector
from padgs.methods.calibration.align import align


def random_poses(count, generator):
    vectors = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    places = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    rotations = [rotation_from_vector(vector, "test") for vector in vectors]
    return torch.stack([rigid(r, -r @ place) for r, place in zip(rotations, places, strict=True)])


def moved(poses, scale, rotation, translation):
    """The same cameras in a world where x_new = scale * rotation @ x + translation."""
    turns = poses[:, :3, :3] @ rotation.mT
    places = scale * centers(poses) @ rotation.mT + translation
    return torch.stack([rigid(turn, -turn @ place) for turn, place in zip(turns, places, strict=True)])


def test_a_known_similarity_is_found(generator):
    poses = random_poses(7, generator)
    rotation = rotation_from_vector(torch.tensor([0.4, -1.1, 2.0], dtype=torch.float64), "test")
    translation = torch.tensor([3.0, -1.0, 0.5], dtype=torch.float64)
    similarity, left = align(moved(poses, 2.5, rotation, translation), poses)
    assert similarity.scale == pytest.approx(2.5)
    torch.testing.assert_close(similarity.rotation, rotation)
    torch.testing.assert_close(similarity.translation, translation)
    assert left.distance.max() < 1e-12
    assert left.degrees.max() < 1e-6


def test_rotation_about_a_straight_path_is_determined():
    poses = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    poses[:, 2, 3] = -torch.arange(5)
    rotation = rotation_from_vector(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), "test")  # about the path
    similarity, left = align(poses, moved(poses, 0.5, rotation, torch.zeros(3, dtype=torch.float64)))
    torch.testing.assert_close(similarity.rotation, rotation.mT)
    assert left.distance.max() < 1e-12


def test_one_wrong_camera_is_measured():
    """One of 100 cameras is turned by 1 degree and stands 0.3 off: it shows by 99 % of that, the others by 1 %."""
    generator = torch.Generator().manual_seed(4)
    poses = random_poses(100, generator)
    wrong = poses.clone()
    turn = rotation_from_vector(torch.tensor([0.0, math.radians(1.0), 0.0], dtype=torch.float64), "test")
    center = centers(poses)[17] + torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64)
    rotation = turn @ poses[17, :3, :3]
    wrong[17] = rigid(rotation, -rotation @ center)
    _, left = align(poses, wrong)
    assert left.degrees.argmax() == left.distance.argmax() == 17
    assert left.degrees[17].item() == pytest.approx(0.99, abs=1e-3)
    assert left.distance[17].item() == pytest.approx(0.3, rel=0.05)
    assert left.degrees.median().item() == pytest.approx(0.01, rel=0.05)


def test_degenerate_poses_are_refused(generator):
    poses = random_poses(3, generator)
    with pytest.raises(ValueError, match="same two or more"):
        align(poses, poses[:2])
    with pytest.raises(ValueError, match="coincide"):
        align(poses, torch.eye(4, dtype=torch.float64).repeat(3, 1, 1))
    mirrored = poses.clone()
    mirrored[:, :3, 3] *= -1  # centres on the other side, while all look where they did
    with pytest.raises(ValueError, match="no shape in common: the best scale is -1"):
        align(poses, mirrored)
