"""A wrong reading of the poses is recognised, and the right one named."""

from collections.abc import Callable

import pytest
import torch
from fixtures import World
from torch import Tensor

from padgs.data.capture import Tracks
from padgs.data.conventions import colour_fit, known_conventions, reprojection_error, track_fit
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
    "OpenGL inverse": (lambda poses: torch.linalg.inv(FLIP @ poses), "world from camera: invert them; camera axes"),
    "turned cloud": (lambda poses: poses @ Z_UP.T, r"different world frames: rotate the points, use \(x, z, -y\)"),
}


@pytest.mark.parametrize("case", MISREADINGS)
def test_colours_tell(case: str, world: World) -> None:
    misread, words = MISREADINGS[case]
    images = torch.stack([torch.from_numpy(image) for image in world.images])
    points, colors = torch.from_numpy(world.points), torch.from_numpy(world.colors)
    fits = colour_fit(misread(_poses(world)), images, points, colors, known_conventions())
    best = max(fits, key=lambda fit: fit.score)
    assert _matches(words, best.convention.words), best.convention.words
    assert best.score > 0.95
    assert case == "none" or fits[0].score < best.score - 0.2


@pytest.mark.parametrize("case", MISREADINGS)
def test_observations_tell(case: str, world: World) -> None:
    misread, words = MISREADINGS[case]
    points, poses = torch.from_numpy(world.points), _poses(world)
    frame = torch.arange(6).repeat_interleave(60)
    point = torch.arange(360)
    seen = (poses[frame][:, :3, :3] @ points[point][..., None])[..., 0] + poses[frame][:, :3, 3]
    tracks = Tracks(frame, point, project(seen, 64, 32))
    fits = track_fit(misread(poses), points, tracks, 64, 32, known_conventions())
    best = max(fits, key=lambda fit: fit.score)
    assert _matches(words, best.convention.words), best.convention.words
    assert -best.score < 1e-9
    assert case == "none" or -fits[0].score > 1


def test_errors_are_angles_and_take_the_short_way() -> None:
    behind = torch.tensor([[-1e-4, 0.0, -1.0]], dtype=torch.float64)  # at the left edge of the image
    assert reprojection_error(behind, torch.tensor([[63.9, 16.0]], dtype=torch.float64), 64, 32) < 0.2
    high = torch.tensor([[0.0, -1.0, 1e-3]], dtype=torch.float64)  # next to the pole a column more means little
    straight = project(high, 64, 32)
    assert reprojection_error(high, straight + torch.tensor([[10.0, 0.0]]), 64, 32) < 0.02


def test_every_reading_is_another() -> None:
    words = [convention.words for convention in known_conventions()]
    assert len(set(words)) == len(words) == 5 * 48 + 47


def _poses(world: World) -> Tensor:
    return _pose(torch.from_numpy(world.rotations), torch.from_numpy(world.translations)[..., None])


def _pose(rotation: Tensor, translation: Tensor) -> Tensor:
    pose = torch.eye(4, dtype=torch.float64).repeat(len(rotation), 1, 1)
    pose[:, :3, :3], pose[:, :3, 3:] = rotation, translation
    return pose


def _center(poses: Tensor) -> Tensor:
    return -poses[:, :3, :3].mT @ poses[:, :3, 3:]


def _matches(pattern: str, words: str) -> bool:
    import re

    return re.search(pattern, words) is not None
