"""Poses as stated in files: conversion and refusal."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from padgs.data.capture import DataError
from padgs.data.formats.poses import (
    cam_from_center,
    cam_from_opengl_pose,
    cam_from_pose,
    checked_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)

numbers = st.floats(-3, 3, allow_nan=False)


@settings(max_examples=50, deadline=None)
@given(st.tuples(numbers, numbers, numbers), st.tuples(numbers, numbers, numbers))
def test_rotation_vectors_quaternions_and_centres_agree(vector, center) -> None:
    angle = math.sqrt(sum(x * x for x in vector))
    sine = math.sin(angle / 2) / angle if angle > 1e-12 else 0.5
    quaternion = torch.tensor([math.cos(angle / 2), *(sine * x for x in vector)], dtype=torch.float64)
    by_vector = rotation_from_vector(torch.tensor(vector, dtype=torch.float64), "here")
    torch.testing.assert_close(by_vector, rotation_from_quaternion(quaternion, "here"), atol=1e-12, rtol=0)
    pose = cam_from_center(by_vector, torch.tensor(center, dtype=torch.float64), "here")
    world = torch.tensor([*center, 1.0], dtype=torch.float64)
    torch.testing.assert_close(pose @ world, torch.tensor([0, 0, 0, 1.0], dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(cam_from_pose(torch.linalg.inv(pose), "here"), pose, atol=1e-10, rtol=0)


def test_quarter_turn_about_z() -> None:
    rotation = rotation_from_vector(torch.tensor([0, 0, math.pi / 2], dtype=torch.float64), "here")
    expected = torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(rotation, expected, atol=1e-15, rtol=0)


def test_an_opengl_camera_looks_along_minus_z_with_y_up() -> None:
    pose = cam_from_opengl_pose(torch.eye(4, dtype=torch.float64), "here")
    ahead_and_up = torch.tensor([0.0, 1.0, -5.0, 1.0], dtype=torch.float64)
    assert (pose @ ahead_and_up).tolist() == [0.0, -1.0, 5.0, 1.0]


def test_rounded_rotations_are_accepted_and_repaired() -> None:
    exact = rotation_from_vector(torch.tensor([0.3, -1.1, 2.0], dtype=torch.float64), "here")
    repaired = checked_rotation((exact * 1e4).round() / 1e4, "here")
    torch.testing.assert_close(repaired @ repaired.T, torch.eye(3, dtype=torch.float64), atol=1e-14, rtol=0)
    torch.testing.assert_close(repaired, exact, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (2.0 * torch.eye(3), "here: the pose holds a rotation times 2"),
        (torch.diag(torch.tensor([1.0, 1.0, -1.0])), r"here: the pose is left-handed \(determinant -1"),
        (torch.tensor([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]), "here: the 3x3 part of the pose is not a rotation"),
        (torch.zeros(3, 3), "here: the rotation is all zeros, so the image has no pose; remove the image"),
        (torch.full((3, 3), math.nan), "here: the pose contains nan"),
        (torch.tensor([[math.inf, 0, 0], [0, 1, 0], [0, 0, 1]]), "contains inf"),
        (torch.eye(2), r"shape \[2, 2\]; it must be 3x3"),
    ],
)
def test_invalid_rotations_are_refused(matrix: torch.Tensor, message: str) -> None:
    with pytest.raises(DataError, match=message):
        checked_rotation(matrix, "here")


def test_a_matrix_of_zeros_is_no_pose() -> None:
    with pytest.raises(DataError, match="here: the rotation is all zeros, so the image has no pose"):
        cam_from_pose(torch.zeros(4, 4), "here")


def test_quaternions_of_another_length() -> None:
    with pytest.raises(DataError, match="here: the rotation is all zeros, so the image has no pose"):
        rotation_from_quaternion(torch.zeros(4), "here")
    with pytest.raises(DataError, match="the length 2; it must be 1"):
        rotation_from_quaternion(torch.tensor([2.0, 0, 0, 0]), "here")
