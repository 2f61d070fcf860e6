"""COLMAP models: written by hand, damaged, and real."""

import os
import shutil
import struct
from pathlib import Path

import pytest
import torch
from support.fixtures import World, write_cloud, write_colmap_binary, write_colmap_text

from padgs.data import DataError, load, read
from padgs.data.conventions import reprojection_errors

POINTS = "1 0 0 5 1 2 3 0.1 1 0\n1 0 0 6 1 2 3 0.1 1 0\n"


def test_tracks_reproject(world: World, tmp_path: Path) -> None:
    write_colmap_binary(world, tmp_path)
    assert _reprojection_error(tmp_path).max() < 1e-9


def test_images_without_pose_are_reported_and_poses_without_image_refused(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    shutil.copy(tmp_path / "images" / "pano_00.png", tmp_path / "images" / "extra.png")
    assert any("1 images have no pose" in note and "extra.png" in note for note in load(tmp_path).notes)
    (tmp_path / "images" / "pano_03.png").unlink()
    with pytest.raises(DataError, match=r"1 of 6 poses have no image in .*images: pano_03.png; set data.images"):
        load(tmp_path)


def test_names_that_differ_in_case_are_found(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    (tmp_path / "images" / "pano_03.png").rename(tmp_path / "images" / "Pano_03.PNG")
    (note,) = (note for note in load(tmp_path).notes if "differ from their files" in note)
    assert note.endswith("'pano_03.png' is images/Pano_03.PNG")
    (tmp_path / "images" / "Pano_03.PNG").unlink()
    os.mkfifo(tmp_path / "images" / "pano_03.png")
    with pytest.raises(
        DataError, match="'pano_03.png' is a pipe, a device or a broken link: put the image in its place"
    ):
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


@pytest.mark.parametrize("file", ["images", "points3D"])
def test_twice_the_number_of_images_is_what_some_versions_of_colmap_state(
    file: str, world: World, tmp_path: Path
) -> None:
    write_colmap_binary(world, tmp_path)
    before, path = load(tmp_path), tmp_path / "sparse/0" / f"{file}.bin"
    content = path.read_bytes()
    count = int.from_bytes(content[:8], "little")
    path.write_bytes((2 * count).to_bytes(8, "little") + content[8:])
    if file == "images":
        scene = load(tmp_path)
        assert scene.fingerprint == before.fingerprint
        assert any("images.bin states 12 images and holds 6, as some versions" in note for note in scene.notes)
        path.write_bytes((2 * count - 1).to_bytes(8, "little") + content[8:])
    with pytest.raises(DataError, match=f"{file}.bin ends early"):
        load(tmp_path)


@pytest.mark.parametrize("points", ["", "1 nan 0 0 1 2 3 0.1\n", "1 1e400 0 0 1 2 3 0.1\n"])
def test_unusable_points_are_refused(points: str, world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    (tmp_path / "sparse/0/points3D.txt").write_text(points)
    with pytest.raises(DataError, match="holds no points|not finite|is empty"):
        load(tmp_path)


def _rewrite(folder: Path, file: str, change) -> None:
    path = folder / "sparse/0" / file
    path.write_text(change(path.read_text()))


def _notes(folder: Path) -> str:
    return "\n".join(load(folder).notes)


def test_references_to_what_is_absent_are_left_out(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    _rewrite(
        tmp_path, "images.txt", lambda text: text.replace(".png\n", ".png\n1.5 2.5 7 3.5 4.5 70001 5 6 -1 nan 6 8\n")
    )
    _rewrite(tmp_path, "points3D.txt", lambda text: text.replace(" 0.1\n", " 0.1 1 0 99 0\n"))
    tracks = read(tmp_path).tracks()  # type: ignore[misc]
    assert tracks.frame.tolist() == list(range(6)) and tracks.pixels[0].tolist() == [1.5, 2.5]
    write_colmap_binary(world, tmp_path / "b")
    model = tmp_path / "b/sparse/0"
    text = (model / "points3D.bin").read_bytes()
    (model / "points3D.bin").write_bytes((399).to_bytes(8, "little") + text[8 : -(len(text) - 8) // 400])
    assert len(load(tmp_path / "b").points) == 399


@pytest.mark.parametrize("second", ["", "\n", "1 2 7\n", "1 2 -1 3 4 7\n"])
def test_second_lines_of_images_txt_may_be_missing(second: str, world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    _rewrite(tmp_path, "images.txt", lambda text: "\ufeff" + text.replace(".png\n\n", f".png\n{second}"))
    assert len(read(tmp_path).frames) == 6
    _rewrite(tmp_path, "images.txt", lambda text: text.replace("pano_01.png", ""))
    with pytest.raises(
        DataError, match=r"images.txt, line \d+: .* is not (X Y POINT3D .*, nor )?ID QW QX QY QZ TX TY TZ CAMERA NAME"
    ):
        load(tmp_path)


@pytest.mark.parametrize("line", ["10.5 20.5 1 30.5 20.5", "1 2 3 4"])
def test_observations_that_are_cut_short(line: str, world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    _rewrite(tmp_path, "images.txt", lambda text: text.replace(".png\n\n", f".png\n{line}\n", 1))
    with pytest.raises(DataError, match=f"images.txt, line .: '{line}' is not X Y POINT3D for each point"):
        load(tmp_path)


@pytest.mark.parametrize("write", [write_colmap_text, write_colmap_binary])
def test_names_of_a_model_in_any_case(write, world: World, tmp_path: Path) -> None:
    write(world, tmp_path)
    before = load(tmp_path).fingerprint
    for file in (tmp_path / "sparse/0").iterdir():
        file.rename(file.with_name(file.name.upper()))
    (tmp_path / "sparse").rename(tmp_path / "Sparse")
    assert load(tmp_path).fingerprint == before


def test_a_camera_that_no_image_has_is_not_checked(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    before = load(tmp_path).fingerprint
    _rewrite(tmp_path, "cameras.txt", lambda text: f"{text}2 SPHERE 128 64 1 60 30\n")
    assert load(tmp_path).fingerprint == before


def test_a_model_without_images_names_a_way_out(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    _rewrite(tmp_path, "images.txt", lambda text: "# none\n")
    with pytest.raises(DataError, match="holds no posed image; export the poses again, or run `padgs prepare"):
        load(tmp_path)


@pytest.mark.parametrize("camera", ["SPHERE 64 32 1 32 16", "EQUIRECTANGULAR 64 32 64 32", "SPHERICAL 64 32"])
def test_names_of_the_panoramic_camera(camera: str, world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    _rewrite(tmp_path, "cameras.txt", lambda text: f"1 {camera}\n")
    assert read(tmp_path).frames[0].width == 64
    _rewrite(tmp_path, "cameras.txt", lambda text: "1 SPHERE 64 32 1 30 16\n")
    with pytest.raises(DataError, match=r"CX CY \(30.0, 16.0\); correct them to its middle, \(32.0, 16.0\)"):
        load(tmp_path)


def test_camera_models_that_colmap_does_not_have(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    _rewrite(tmp_path, "cameras.txt", lambda text: "1 Equirectangular 64 32 64 32\n")
    assert read(tmp_path).frames[0].lens is None
    _rewrite(tmp_path, "cameras.txt", lambda text: "1 OPENCV_SPHERICAL 64 32\n")
    with pytest.raises(DataError, match=r"pano_00.png in .* has a OPENCV_SPHERICAL camera; .*EQUIRECTANGULAR: write"):
        load(tmp_path)


def test_texts_in_the_unicode_of_windows_and_indented_comments(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    before = load(tmp_path)
    for file in (tmp_path / "sparse/0").glob("*.txt"):
        file.write_text(f"  # made elsewhere\n{file.read_text()}", encoding="utf-16")
    assert load(tmp_path).fingerprint == before.fingerprint


@pytest.mark.parametrize("form", ["utf-16", "CR", "CRLF"])
def test_the_largest_part_is_used_in_any_form_of_text(form: str, world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    large, few = tmp_path / "sparse" / "0", tmp_path / "sparse" / "1"
    shutil.copytree(large, few)
    lines = (large / "images.txt").read_text().splitlines()
    (few / "images.txt").write_text("\n".join(line for line in lines if "pano_0" not in line or "pano_00" in line))
    text = (large / "images.txt").read_text()
    ends = {"CR": "\r", "CRLF": "\r\n"}.get(form, "\n")
    (large / "images.txt").write_bytes(text.replace("\n", ends).encode("utf-16" if form == "utf-16" else "utf-8"))
    assert len(read(tmp_path).frames) == 6


def test_numbers_have_no_underscores(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    assert "pano_00.png" in (tmp_path / "sparse" / "0" / "images.txt").read_text(), "names may"
    _rewrite(tmp_path, "cameras.txt", lambda text: "1 EQUIRECTANGULAR 6_4 32\n")
    with pytest.raises(DataError, match=r"cameras.txt, line 1: '1 EQUIRECTANGULAR 6_4 32' is not ID MODEL WIDTH"):
        read(tmp_path)


def test_two_cameras_of_one_id_are_refused(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    once = "1 EQUIRECTANGULAR 64 32\n"
    _rewrite(tmp_path, "cameras.txt", lambda text: 2 * once)
    assert read(tmp_path).frames[0].width == 64, "the same twice says nothing else"
    _rewrite(tmp_path, "cameras.txt", lambda text: f"{once}1 EQUIRECTANGULAR 128 64\n")
    with pytest.raises(DataError, match=r"cameras.txt has 1 twice, with different values; remove one, or export it"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("file", "entry"),
    [("images.txt", "1 1 0 0 0 5 5 5 1 pano_00.png\n\n1 1 0 0 0 6 6 6 1 pano_01.png\n\n"), ("points3D.txt", POINTS)],
)
def test_two_entries_of_one_id_are_refused(file: str, entry: str, world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    _rewrite(tmp_path, file, lambda text: entry)
    with pytest.raises(DataError, match=rf"{file} has 1 twice, with different values"):
        read(tmp_path)


def test_binary_sphere_cameras(world: World, tmp_path: Path) -> None:
    write_colmap_binary(world, tmp_path)
    file = tmp_path / "sparse/0/cameras.bin"
    file.write_bytes(struct.pack("<QIiQQ3d", 1, 1, 11, 64, 32, 1, 32, 16))
    assert read(tmp_path).frames[0].height == 32
    file.write_bytes(struct.pack("<QIiQQ16d", 1, 1, 11, 64, 32, *range(16)))
    with pytest.raises(DataError, match=r"other cameras \(pano_00.png\)"):
        load(tmp_path)


def test_names_that_are_not_utf_8_name_their_file(world: World, tmp_path: Path) -> None:
    write_colmap_binary(world, tmp_path)
    file = tmp_path / "sparse/0/images.bin"
    file.write_bytes(file.read_bytes().replace(b"pano_03", b"\xb3\xf8o_03"))
    with pytest.raises(DataError, match=r"images.bin names .*, which is not Unicode; rename the file"):
        load(tmp_path)


def test_points_may_be_a_ply_file_beside_the_model(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    (tmp_path / "sparse/0/points3D.txt").unlink()
    with pytest.raises(DataError, match="lacks points3D .*or set data.points to a PLY file or to random"):
        load(tmp_path)
    assert len(load(tmp_path, points="random").points) == 100_000
    write_cloud(world, tmp_path / "sparse/0/points3D.ply")
    assert torch.equal(load(tmp_path).point_colors, torch.from_numpy(world.colors))
    assert "points: from a PLY file beside the model" in _notes(tmp_path)


@pytest.mark.parametrize("points", ["", "# none\n"])
def test_a_ply_file_stands_in_for_a_model_without_points(points: str, world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    write_cloud(world, tmp_path / "sparse/0/points3D.ply")
    (tmp_path / "sparse/0/points3D.txt").write_text(points)
    scene = load(tmp_path)
    assert torch.equal(scene.point_colors, torch.from_numpy(world.colors))
    assert "points: from a PLY file beside the model, which has no points of its own" in scene.notes
    (tmp_path / "sparse/0/points3D.txt").write_text("1 2\n")
    with pytest.raises(DataError, match=r"points3D.txt, line 1: '1 2' is not ID"):
        load(tmp_path)


def test_text_and_binary_in_one_folder(world: World, tmp_path: Path) -> None:
    write_colmap_binary(world, tmp_path)
    (tmp_path / "sparse/0/images.txt").write_text("1 0 0 0 0 0 0 0 1 other.png")
    assert "images.bin are used, not the text files" in _notes(tmp_path)


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
    poses = torch.stack([frame.cam_from_world for frame in capture.frames])
    width, height = capture.frames[0].width, capture.frames[0].height
    return reprojection_errors(poses, capture.cloud.points, capture.tracks(), width, height)
