"""COLMAP models: written by hand, damaged, and real."""

import shutil
from pathlib import Path

import pytest
import torch
from support.fixtures import World, write_colmap_binary, write_colmap_text

from padgs.data import DataError, load, read
from padgs.geometry.panorama import project


def test_tracks_reproject(world: World, tmp_path: Path) -> None:
    write_colmap_binary(world, tmp_path)
    assert _reprojection_error(tmp_path).max() < 1e-9


def test_names_with_spaces_and_accents(world: World, tmp_path: Path) -> None:
    folder = tmp_path / "été à la mer"
    write_colmap_text(world, folder)
    for name in world.names:
        (folder / "images" / f"{name}.png").rename(folder / "images" / f"{name} n° 1.png")
    for file in ("sparse/0/images.txt", "train.txt", "test.txt"):
        text = (folder / file).read_text()
        (folder / file).write_text(text.replace(".png", " n° 1.png"), encoding="utf-8")
    assert load(folder).train[0].name == f"{world.train[0]} n° 1"


def test_images_without_pose_are_reported_and_poses_without_image_refused(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    shutil.copy(tmp_path / "images" / "pano_00.png", tmp_path / "images" / "extra.png")
    assert any("1 images have no pose" in note and "extra.png" in note for note in load(tmp_path).notes)
    (tmp_path / "images" / "pano_03.png").unlink()
    with pytest.raises(DataError, match=r"1 of 6 poses have no image in .*images: pano_03.png; set data.images"):
        load(tmp_path)


def test_names_that_differ_in_case_are_reported(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    (tmp_path / "images" / "pano_03.png").rename(tmp_path / "images" / "Pano_03.PNG")
    with pytest.raises(DataError, match="there is 'Pano_03.PNG', which differs in case: rename it"):
        load(tmp_path)


@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("damage", ["cut", "garbage", "longer"])
def test_damaged_binary_files_are_named(file: str, damage: str, world: World, tmp_path: Path) -> None:
    write_colmap_binary(world, tmp_path)
    path = tmp_path / "sparse" / "0" / f"{file}.bin"
    data = path.read_bytes()
    broken = {"cut": data[: len(data) - 7], "garbage": bytes(range(7, 256)) * 3, "longer": data + b"xx"}
    path.write_bytes(broken[damage])
    with pytest.raises(DataError, match=f"{file}.bin"):
        load(tmp_path)


def test_other_cameras_are_refused(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    (tmp_path / "sparse/0/cameras.txt").write_text("1 PINHOLE 64 32 50 50 32 16\n")
    with pytest.raises(DataError, match="pano_00.png has a PINHOLE camera"):
        load(tmp_path)


@pytest.mark.parametrize("points", ["", "1 nan 0 0 1 2 3 0.1\n", "1 1e400 0 0 1 2 3 0.1\n"])
def test_unusable_points_are_refused(points: str, world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    (tmp_path / "sparse/0/points3D.txt").write_text(points)
    with pytest.raises(DataError, match="holds no points|not finite|is empty"):
        load(tmp_path)


def test_a_model_with_a_file_missing(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    (tmp_path / "sparse/0/points3D.txt").unlink()
    with pytest.raises(DataError, match="lacks points3D"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("name", "train", "test", "points", "width"),
    [("flat", 8, 3, 13775, 2048), ("room", 36, 9, 72000, 1024), ("garden", 3, 1, 3377, 2048)],
)
def test_the_real_models(name: str, train: int, test: int, points: int, width: int, shared: Path) -> None:
    scene = load(shared / "data" / name)
    assert (len(scene.train), len(scene.test), len(scene.points)) == (train, test, points)
    assert scene.train[0].width == width and scene.train[0].height == width // 2
    assert scene.point_colors.float().std() > 10
    assert (scene.train[0].mask() is not None) == (name == "flat")


def test_the_flat_reprojects(shared: Path) -> None:
    error = _reprojection_error(shared / "data" / "flat")
    assert len(error) == 62523
    assert error.median() < 0.3


def _reprojection_error(path: Path) -> torch.Tensor:
    capture = read(path)
    assert capture.tracks is not None and capture.cloud is not None
    tracks = capture.tracks()
    pose = torch.stack([frame.cam_from_world for frame in capture.frames])[tracks.frame]
    points = (pose[:, :3, :3] @ capture.cloud.points[tracks.point][..., None])[..., 0] + pose[:, :3, 3]
    width, height = capture.frames[0].width, capture.frames[0].height
    difference = project(points, width, height) - tracks.pixels
    difference[:, 0] = (difference[:, 0] + width / 2) % width - width / 2  # the seam
    return difference.norm(dim=1)
