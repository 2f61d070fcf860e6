"""Pose conventions and exposures estimated from points and images."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.fixtures import World, write_colmap_text
from torch import Tensor

from padgs.cli.check import lines
from padgs.data.capture import Tracks
from padgs.data.check import check
from padgs.data.conventions import colour_fit, exposure_gains, known_conventions, reprojection_errors
from padgs.geometry.panorama import project

FLIP = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
MIRROR = torch.diag(torch.tensor([-1.0, 1, 1, 1], dtype=torch.float64))
Z_UP = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)

MISREADINGS: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "none": (lambda poses: poses, "the poses are right as they are"),
    "OpenGL": (lambda poses: FLIP @ poses, r"camera axes: use \(x, -y, -z\) .*, the convention of OpenGL, Blender"),
    "mirrored": (lambda poses: MIRROR @ poses, r"camera axes: use \(-x, y, z\) .*, which mirrors"),
    "inverse": (torch.linalg.inv, "the poses are world from camera: invert them"),
    "transposed": (
        lambda poses: _pose(poses[:, :3, :3].mT, -poses[:, :3, :3].mT @ _center(poses)),
        "the rotations are transposed: transpose them and keep the centres",
    ),
    "centre for translation": (
        lambda poses: _pose(poses[:, :3, :3], _center(poses)),
        "the translations are camera centres",
    ),
    "translation for centre": (
        lambda poses: _pose(poses[:, :3, :3], -poses[:, :3, :3] @ poses[:, :3, 3:]),
        "the camera centres are translations",
    ),
    "x y z w": (lambda poses: _pose(_misread(poses), poses[:, :3, 3:]), "the quaternions are in the order x y z w"),
    "OpenGL inverse": (lambda poses: torch.linalg.inv(FLIP @ poses), "world from camera: invert them; camera axes"),
    "OpenGL, camera from world": (
        lambda poses: FLIP @ torch.linalg.inv(FLIP @ poses),
        "the matrices are camera from world: invert them$",
    ),
    "OpenCV, camera from world": (
        lambda poses: FLIP @ torch.linalg.inv(poses),
        r"the matrices are camera from world: invert them; camera axes: use \(x, -y, -z\)",
    ),
    "turned cloud": (lambda poses: poses @ Z_UP.T, r"different world frames: rotate the points, use \(x, z, -y\)"),
}


@pytest.mark.parametrize("case", MISREADINGS)
def test_colours_identify_the_convention(case: str, world: World) -> None:
    misread, words = MISREADINGS[case]
    images = torch.stack([torch.from_numpy(image) for image in world.images])
    points, colors = torch.from_numpy(world.points), torch.from_numpy(world.colors)
    poses = misread(_poses(world))
    fits = [colour_fit(known.convert(poses), images, points, colors) for known in known_conventions()]
    _check_words(words, fits)
    assert max(fits) > 0.95
    assert case == "none" or fits[0] < max(fits) - 0.2


@pytest.mark.parametrize(("case", "part"), [("none", 3), ("OpenGL", 3), ("turned cloud", 6)])
def test_colours_of_narrow_pictures_identify_the_convention(case: str, part: int, world: World) -> None:
    misread, words = MISREADINGS[case]
    images = torch.stack([torch.from_numpy(image) for image in world.images])
    shown = torch.zeros(32, 64, 1, dtype=torch.uint8)
    poses = misread(_poses(world))
    shown[16 - 16 // part : 16 + 16 // part, 32 - 32 // part : 32 + 32 // part] = 1
    points, colors = torch.from_numpy(world.points), torch.from_numpy(world.colors)
    fits = [colour_fit(known.convert(poses), images * shown, points, colors) for known in known_conventions()]
    _check_words(words, fits)
    assert max(fits) > 0.95
    assert case == "none" or fits[0] < max(fits) - 0.2


def test_colours_of_black_pictures_are_unrelated(world: World) -> None:
    points, colors = torch.from_numpy(world.points), torch.from_numpy(world.colors)
    assert colour_fit(_poses(world), torch.zeros(6, 32, 64, 3, dtype=torch.uint8), points, colors) == 0.0


@pytest.mark.parametrize("case", MISREADINGS)
def test_observations_identify_the_convention(case: str, world: World) -> None:
    misread, words = MISREADINGS[case]
    points, poses = torch.from_numpy(world.points), _poses(world)
    frame = torch.arange(6).repeat_interleave(60)
    point = torch.arange(360)
    seen = (poses[frame][:, :3, :3] @ points[point][..., None])[..., 0] + poses[frame][:, :3, 3]
    tracks = Tracks(frame, point, project(seen, 64, 32))
    candidates = (known.convert(misread(poses)) for known in known_conventions())
    fits = [-reprojection_errors(pose, points, tracks, 64, 32).median().item() for pose in candidates]
    _check_words(words, fits)
    assert -max(fits) < 1e-9
    assert case == "none" or -fits[0] > 1


def test_reprojection_errors_wrap_and_shrink_near_poles() -> None:
    behind_and_high = torch.tensor([[-1e-4, 0.0, -1.0], [0.0, -1.0, 1e-3]], dtype=torch.float64)
    pixels = project(behind_and_high, 64, 32) + torch.tensor([[63.9, 0.0], [10.0, 0.0]])
    tracks = Tracks(torch.tensor([0, 0]), torch.tensor([0, 1]), pixels)
    errors = reprojection_errors(torch.eye(4)[None], behind_and_high, tracks, 64, 32)
    assert errors[0] < 0.2, "the seam"
    assert errors[1] < 0.02, "next to the pole a column more means little"


def test_conventions_are_distinct() -> None:
    words = [convention.words for convention in known_conventions()]
    assert len(set(words)) == len(words) == 7 * 48 + 47


def _poses(world: World) -> Tensor:
    return _pose(torch.from_numpy(world.rotations), torch.from_numpy(world.translations)[..., None])


def _pose(rotation: Tensor, translation: Tensor) -> Tensor:
    pose = torch.eye(4, dtype=torch.float64).repeat(len(rotation), 1, 1)
    pose[:, :3, :3], pose[:, :3, 3:] = rotation, translation
    return pose


def _misread(poses: Tensor) -> Tensor:
    """Return the rotations whose quaternion x y z w was read as w x y z."""
    x_y_z_w = Rotation.from_matrix(poses[:, :3, :3].numpy()).as_quat()
    return torch.from_numpy(Rotation.from_quat(x_y_z_w[:, [1, 2, 3, 0]]).as_matrix())


def _center(poses: Tensor) -> Tensor:
    return -poses[:, :3, :3].mT @ poses[:, :3, 3:]


def _check_words(pattern: str, fits: list[float]) -> None:
    words = known_conventions()[fits.index(max(fits))].words
    assert re.search(pattern, words), words


STOPS = np.array([0.0, -0.5, 0.3, -0.2, 0.0, 0.1])


def exposed(world: World) -> World:
    images = (image / 2 * 2.0**stop for image, stop in zip(world.images, STOPS, strict=True))
    return replace(world, images=tuple(image.round().astype(np.uint8) for image in images))


def test_gains_are_robust_to_hidden_points(world: World) -> None:
    poses = torch.stack([torch.from_numpy(np.linalg.inv(world.world_from_cam(i))) for i in range(6)])
    images = torch.stack([torch.from_numpy(image) for image in exposed(world).images])
    images[2, :, :20] = images[2, :, 20:40]  # something stands before what the others show
    gains = exposure_gains(poses, images, torch.from_numpy(world.points))
    assert np.abs(gains.numpy() - (STOPS - np.median(STOPS))).max() < 0.05


def test_check_warns_of_uneven_exposures(world: World, tmp_path: Path) -> None:
    write_colmap_text(exposed(world), tmp_path)
    report = check(tmp_path)
    assert any("(pano_02); train with train.exposures=learned" in note for note in report.notes), report.notes
    assert report.problems == [] and any("exposures      differ by a factor of 1." in line for line in lines(report))


def test_a_dark_room_is_no_dark_exposure(world: World) -> None:
    images, seen = torch.from_numpy(np.stack(world.images)), torch.zeros(6, 400, dtype=torch.bool)
    images[3:] = images[3:] // 3
    seen[:3, :200] = seen[3:, 200:] = True  # two rooms
    points = torch.from_numpy(world.points)
    assert exposure_gains(_poses(world), images, points).std() > 0.5
    assert exposure_gains(_poses(world), images, points, seen).std() < 0.1
