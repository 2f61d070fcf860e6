"""Metashape's cameras.xml: frames of poses and points, names, and refusals."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support.fixtures import World, make_world, write_metashape

from padgs.data import DataError, load, read
from padgs.data.capture import Cloud
from padgs.data.cloud import read_ply, write_ply


@pytest.fixture
def folder(world: World, tmp_path: Path) -> Path:
    write_metashape(world, tmp_path)
    return tmp_path


LAST = r"<transform>(?:(?!<transform>).)*</transform></chunk>"


def _edit(folder: Path, *changes: tuple[str, str]) -> None:
    text = (folder / "cameras.xml").read_text()
    for pattern, new in changes:
        assert re.search(pattern, text), pattern
        text = re.sub(pattern, new, text)
    (folder / "cameras.xml").write_text(text)


def test_a_file_of_another_name_in_utf_16_is_found(folder: Path) -> None:
    before = load(folder).fingerprint
    text = re.sub("(?i)utf-8", "utf-16", (folder / "cameras.xml").read_text())
    (folder / "room.xml").write_text(text, encoding="utf-16")
    (folder / "cameras.xml").unlink()
    assert load(folder).fingerprint == before


def test_golden_poses_come_back(shared: Path, tmp_path: Path) -> None:
    golden = [np.load(file) for file in sorted((shared / "golden").glob("erp_*.npz"))]
    rotations, shifts = (np.stack([one[key] for one in golden]).astype(float) for key in "Rt")
    world = make_world(len(golden), width=16, points=3)
    centers = -np.einsum("fji,fj->fi", rotations, shifts)
    write_metashape(replace(world, rotations=rotations, centers=centers), tmp_path)
    for frame, rotation, shift in zip(read(tmp_path).frames, rotations, shifts, strict=True):
        np.testing.assert_allclose(frame.cam_from_world[:3, :3], rotation, atol=1e-6)  # golden poses are float32
        np.testing.assert_allclose(frame.cam_from_world[:3, 3], shift, atol=1e-6)


@pytest.mark.parametrize("cloud", ["chunk", "world"])
def test_the_frame_of_points_is_decided_by_their_colours(cloud: str, world: World, tmp_path: Path) -> None:
    write_metashape(world, tmp_path, cloud=cloud)
    scene = load(tmp_path)
    assert any(f"points in the frame of the {cloud}: colours agree by 0.9" in note for note in scene.notes)
    torch.testing.assert_close(scene.points, torch.from_numpy(world.points).float())


def test_the_frame_of_named_points_is_decided_too(world: World, tmp_path: Path) -> None:
    write_metashape(world, tmp_path, cloud="world")
    (tmp_path / "scans").mkdir()
    (tmp_path / "dense.ply").rename(tmp_path / "scans/a.ply")
    (tmp_path / "dense.ply").write_text("damaged, and not used")
    scene = load(tmp_path, points="scans/a.ply")
    assert any("points in the frame of the world: colours agree by 0.9" in note for note in scene.notes)
    torch.testing.assert_close(scene.points, torch.from_numpy(world.points).float())


@pytest.mark.parametrize("cloud", ["chunk", "world"])
def test_points_without_colours_are_those_of_the_world_unless_they_miss_the_cameras(
    cloud: str, world: World, tmp_path: Path
) -> None:
    write_metashape(world, tmp_path, cloud=cloud)
    write_ply(tmp_path / "dense.ply", Cloud(read_ply(tmp_path / "dense.ply").points, None))
    scene = load(tmp_path)
    assert any(f"points in the frame of the {cloud}: not tested by colours" in note for note in scene.notes)
    torch.testing.assert_close(scene.points, torch.from_numpy(world.points).float())


@pytest.mark.parametrize("colors", [None, torch.zeros(0, 3, dtype=torch.uint8)])
def test_an_empty_cloud_is_refused_by_name(colors: torch.Tensor | None, folder: Path) -> None:
    write_ply(folder / "dense.ply", Cloud(torch.zeros(0, 3, dtype=torch.float64), colors))
    with pytest.raises(DataError, match="holds no points; training starts from a point cloud"):
        load(folder)


def test_a_disabled_chunk_is_not_used(folder: Path) -> None:
    text = (folder / "cameras.xml").read_text()
    chunk = re.search(r"<chunk .*</chunk>", text, re.DOTALL)[0]  # type: ignore[index]
    other = re.sub("<chunk [^>]*>", '<chunk label="old" enabled="false">', chunk)
    (folder / "cameras.xml").write_text(text.replace(chunk, other + chunk))
    assert any("holds 2 chunks; 'Chunk 1' is used" in note for note in read(folder).notes)


def test_photographs_of_other_sensors_are_left_out_on_request(folder: Path) -> None:
    _edit(folder, ('<camera id="0" sensor_id="0"', '<camera id="0" sensor_id="2"'))
    with pytest.raises(DataError, match=r"type 'frame'; only 'spherical' .*; leave out .* with data.cameras=panoramas"):
        load(folder)
    scene = load(folder, cameras="panoramas", split="every")
    assert len(scene.train) + len(scene.test) == 5
    assert any("1 of 6 images are no panoramas; they are left out" in note for note in scene.notes)


def test_cameras_without_use_are_noted(folder: Path) -> None:
    notes = " ".join(read(folder).notes)
    assert "1 cameras are disabled in Metashape" in notes and "1 cameras have no <transform> (not aligned)" in notes
    _edit(folder, ("<chunk ", '<chunk label="old"/><chunk '))
    (folder / "cameras.xml").rename(folder / "export of monday.xml")
    assert any("holds 2 chunks; 'Chunk 1' is used" in note for note in read(folder).notes)
    assert read(folder / "export of monday.xml").format == "metashape"


def test_equal_labels_are_those_of_folders(folder: Path) -> None:
    for name in ("Group 1", "day.2"):
        (folder / "images" / name).mkdir()
    for old, new in (("pano_00", "Group 1/IMG.1"), ("pano_02", "day.2/IMG.1")):
        (folder / "images" / f"{old}.png").rename(folder / "images" / f"{new}.png")
    (folder / "train.txt").unlink()
    labels = [("pano_00", "IMG.1"), ("pano_02", "IMG.1"), ("</group>", '</group><group label="day.2">')]
    _edit(folder, *labels, ("</cameras>", "</group></cameras>"))
    names = [frame.name for frame in read(folder).frames]
    assert names[0] == "Group 1/IMG.1.png" and names[2] == "day.2/IMG.1.png"
    _edit(folder, ('"day.2"', '"Group 1"'))
    with pytest.raises(
        DataError, match="several cameras with the label Group 1/IMG.1; .* a camera group that is named"
    ):
        read(folder)


def test_labels_without_folder_or_ending_are_found_in_folders(folder: Path) -> None:
    """Only labels that occur twice have their group in front."""
    for name in ("Group 1", "day 2"):
        (folder / "images" / name).mkdir()
    for number in range(6):
        place = "Group 1" if number < 2 else "day 2"
        (folder / f"images/pano_0{number}.png").rename(folder / f"images/{place}/pano_0{number}.JPG")
    (folder / "images/masks").mkdir()
    (folder / "images/masks/pano_03.png").touch()  # no photograph
    names = [frame.name for frame in read(folder).frames]
    assert names == [f"{'Group 1' if n < 2 else 'day 2'}/pano_0{n}.JPG" for n in range(6)]
    (folder / "images/third").mkdir()
    (folder / "images/third/pano_03.png").touch()
    with pytest.raises(DataError, match="'pano_03' of the metashape data set may be day 2/.*, third/"):
        read(folder)


def test_a_label_with_its_group_is_no_image_of_another_group(folder: Path) -> None:
    _edit(folder, ('label="pano_00"', 'label="one/pano_00"'))
    (folder / "images/two").mkdir()
    for number in range(6):
        (folder / f"images/pano_0{number}.png").rename(folder / f"images/two/pano_0{number}.JPG")
    assert [frame.name for frame in read(folder).frames][:2] == ["one/pano_00", "two/pano_01.JPG"]


def test_without_transforms_the_frame_is_that_of_the_chunk(folder: Path) -> None:
    _edit(folder, ('component_id="1"', 'component_id="0"'), (r"(?s)</cameras><transform>.*</transform>", "</cameras>"))
    _edit(folder, (r"(?s)<components>.*</components>", ""))
    assert any("lengths are in the chunk's own unit" in note for note in read(folder).notes)


@pytest.mark.parametrize(
    ("pattern", "new", "message"),
    [
        ("</chunk>", "", r"cameras.xml is not valid XML \(mismatched tag: line 2"),
        ("document", "project", "holds no <chunk> in a <document>"),
        (
            'label="S1" type="spherical"',
            'label="S1" type="cylindrical"',
            "<sensor id='1' label='S1'> has the type 'cyl",
        ),
        ('<sensor id="1"', '<sensor id="7"', "cameras use <sensor id='1'>, which is not in <sensors>"),
        ('<sensor id="1"', '<sensor id="0"', "<sensors> of .*cameras.xml has '0' twice, with different values"),
        (
            r'<resolution width="64"',
            '<resolution width="wide"',
            "<sensor id='0' label='S0'> lacks <resolution width= h",
        ),
        (r"(?s)<component id=.1. label=.Component 1.><transform>.*?</transform>", '<component id="1">', "2 components"),
        (r"<scale>[^<]*", "<scale>0", "<transform> of .* the scale is 0; it must be positive"),
        (
            LAST,
            "<transform>0 2 0 0 -2 0 0 0 0 0 2 0 5 6 7 1</transform></chunk>",
            "the pose is transposed, its last row",
        ),
        (LAST, "<transform>0 2 0 5 -2 0 0 6 0 0 -2 7 0 0 0 1</transform></chunk>", "of the chunk .* left-handed"),
        (r"<rotation>[^<]*", "<rotation>1 0 0 0 1 0 0 0 2", "<transform> of .* is not a rotation"),
        (r"<translation>[^<]*", "<translation>1 2", "<translation> of <transform> of .* must hold 3 finite numbers"),
        (r"(pano_02.*?<transform>)\S+", r"\1nan", "<transform> of camera 'pano_02' in .* must hold 16 finite"),
        (r"(pano_02.*?<transform>)\S+", r"\1west", "camera 'pano_02' in .* could not convert string to float: 'west'"),
        ('enabled="true">', 'enabled="false">', "no enabled camera with a <transform>; align the photos"),
        ('label="pano_02"', "", "holds a camera without label"),
    ],
)
def test_what_cannot_be_known_is_refused(pattern: str, new: str, message: str, folder: Path) -> None:
    _edit(folder, (pattern, new))
    with pytest.raises(DataError, match=message):
        load(folder)
