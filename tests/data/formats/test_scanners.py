"""Captures and clouds of scanners: NavVis, E57 and LAS."""

import contextlib
import importlib
import os
import re
import struct
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from support.fixtures import PANORAMA, World, quaternion, write_images, write_navvis

from padgs.data import DataError, load, read
from padgs.data import scans as scans_module
from padgs.data.capture import Cloud, DataOptions
from padgs.data.cloud import joined, read_cloud, write_ply
from padgs.data.formats.scanners import _named_images


@pytest.mark.parametrize(("turn", "along"), [(0, "x"), (90, "y"), (180, "-x"), (-90, "-y")])
def test_turned_images_of_navvis_are_recognised_by_colours(turn: float, along: str, world: World, tmp_path: Path):
    write_navvis(world, tmp_path, turn)
    scene = load(tmp_path)
    assert any(f"centres of images along {along} of their poses: colours agree by 0.9" in note for note in scene.notes)
    for view in scene.train:
        rotation = torch.from_numpy(world.rotations[world.names.index(view.name)])
        torch.testing.assert_close(view.cam_from_world[:3, :3], rotation, atol=1e-12, rtol=0)


def test_quoted_names_of_navvis_and_decimal_commas(world: World, tmp_path: Path) -> None:
    write_navvis(world, tmp_path)
    file = tmp_path / "pano" / "pano-poses.csv"
    before, text = load(tmp_path), file.read_text()
    file.write_text(re.sub(r"(pano_\d+\.png)", r'"\1"', text))
    assert load(tmp_path).fingerprint == before.fingerprint
    file.write_text(re.sub(r"(\d)\.(\d+)$", r"\1,\2", text, flags=re.MULTILINE))
    with pytest.raises(DataError, match=r"pano-poses.csv, line 2: .*; export the poses again, with decimal points"):
        load(tmp_path)


def test_every_path_to_a_scan_of_navvis_finds_its_points(world: World, tmp_path: Path) -> None:
    write_navvis(world, tmp_path / "scan", 90)
    pano = tmp_path / "scan" / "pano"
    pano.mkdir(exist_ok=True)
    for file in [*(tmp_path / "scan").glob("*.csv"), *(tmp_path / "scan").glob("*.png")]:
        file.rename(pano / file.name)
    (tmp_path / "scan" / "rest.e57").touch()
    for path in (tmp_path / "scan", pano, pano / "pano-poses.csv"):
        scene = load(path)
        assert len(scene.points) == len(world.points), path
        assert any("along y of their poses: colours agree by 0.9" in note for note in scene.notes), path
        assert not any("not used: rest.e57" in note for note in scene.notes)


def test_images_of_e57_files_that_would_share_a_name_are_numbered() -> None:
    class Node(dict):
        isDefined = dict.__contains__
        childCount = dict.__len__

        def value(self) -> str:
            return self["value"]

    stated = ["a", "a.jpg", "A.PNG", "a.1", "a.2"]
    images = Node(enumerate(Node(name=Node(value=name)) for name in stated))
    names = [name for name, _ in _named_images(SimpleNamespace(root=Node(images2D=images)))]
    assert names == ["a", "a.jpg_00001", "A.PNG_00002", "a.1", "a.2"]


@pytest.mark.parametrize("black", [False, True])
def test_scans_without_colours_do_not_hide_those_of_others(black: bool) -> None:
    points = torch.arange(12, dtype=torch.float64).reshape(4, 3)
    plain = Cloud(points[3:], torch.zeros(1, 3, dtype=torch.uint8) if black else None)
    coloured = Cloud(points[:3], torch.full((3, 3), 9, dtype=torch.uint8))
    for clouds in ([coloured, plain], [plain, coloured]):
        cloud, (note,) = joined(clouds)
        assert torch.equal(cloud.points, points[:3]) and torch.equal(cloud.colors, coloured.colors)
        assert note == "points: 1 of scans without colours are left out, as others have colours"
    cloud, notes = joined([plain, plain])
    assert len(cloud.points) == 2 and cloud.colors is None and not notes


@pytest.mark.parametrize("points", ["random", "grey.ply"])
def test_other_points_do_not_turn_the_cameras(points: str, world: World, tmp_path: Path) -> None:
    write_navvis(world, tmp_path / "scan", 180)
    (tmp_path / "scan" / "x").mkdir()
    write_ply(tmp_path / "scan" / "x" / "grey.ply", Cloud(torch.from_numpy(world.points), None))
    scene = load(tmp_path / "scan", points=points.replace("grey", "x/grey"))
    assert any("centres of images along -x of their poses: colours agree by 0.9" in note for note in scene.notes)
    assert sum("format: navvis" in note for note in scene.notes) == 1
    assert len(scene.points) == (400 if points == "grey.ply" else 100_000)
    view = scene.train[0]
    rotation = torch.from_numpy(world.rotations[world.names.index(view.name)])
    torch.testing.assert_close(view.cam_from_world[:3, :3], rotation, atol=1e-12, rtol=0)
    for file in (tmp_path / "scan").glob("*.ply"):
        file.unlink()
    notes = load(tmp_path / "scan", points=points.replace("grey", "x/grey")).notes
    assert any("centres of images along x of their poses: not tested by colours" in note for note in notes)


@pytest.mark.parametrize("mark", ["; ", "\t", ", "])
def test_comments_marks_and_case_of_navvis(mark: str, world: World, tmp_path: Path) -> None:
    write_navvis(world, tmp_path)
    before, file = load(tmp_path), tmp_path / "pano" / "pano-poses.csv"
    head, *rows = file.read_text().replace("; ", mark).splitlines()
    lines = ["# made by a scanner", head.replace("pano_pos", "Pano_Pos"), "# rows", *rows]
    file.write_text("\n".join(lines))
    assert torch.equal(load(tmp_path).train[0].cam_from_world, before.train[0].cam_from_world)


def test_colours_that_agree_with_no_reading_are_named(world: World, tmp_path: Path) -> None:
    write_navvis(replace(world, centers=1000 * world.centers + 3), tmp_path)
    notes = load(tmp_path).notes
    assert any("colours agree by" in note and "the poses may be wrong: run padgs check" in note for note in notes)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("; pano_ori_w", "", r"pano-poses.csv, line 1 lacks the columns pano_ori_w; export"),
        (
            "1644454371.893008; ",
            "1644454371.893008; x",
            r"pano-poses.csv, line 2: '0; pano_00.png; .* is not ID; filename",
        ),
        ("1644454371.893008; ", "", r"pano-poses.csv, line 2: '0; pano_00.png; .* is not ID; filename"),
        ("1644454371.893008; ", "1644454371.893008; nan", r"pano-poses.csv, line 2"),
        ("pano_00", "../pano_00", r"names '../pano_00.png'|6 views|"),
    ],
)
def test_invalid_rows_of_navvis_are_refused(old: str, new: str, message: str, world: World, tmp_path: Path) -> None:
    write_navvis(world, tmp_path)
    file = tmp_path / "pano" / "pano-poses.csv"
    file.write_text(file.read_text().replace(old, new, 1))
    if old == "pano_00":
        assert len(load(file).train) == 4, "names are found by their end"
        return
    with pytest.raises(DataError, match=message):
        load(tmp_path)


@pytest.mark.parametrize("name", ["pye57", "laspy"])
def test_missing_packages_are_named(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    file = tmp_path / ("a.e57" if name == "pye57" else "a.laz")
    file.write_bytes(b"no scan")
    with pytest.raises(
        DataError, match=rf"a\.\w+ needs {name}, which cannot be imported .*pip install 'padgs\[scanners\]'"
    ):
        read_cloud(file)


@pytest.fixture
def laspy() -> ModuleType:
    return pytest.importorskip("laspy", reason="laspy is not installed: pip install 'padgs[scanners]'")


@pytest.mark.parametrize(("end", "scale", "coloured"), [("las", 257, True), ("laz", 1, True), ("las", 1, False)])
def test_las_clouds(end: str, scale: int, coloured: bool, laspy, world: World, tmp_path: Path, monkeypatch) -> None:
    data = laspy.LasData(laspy.LasHeader(point_format=2 if coloured else 1, version="1.2"))
    data.header.scales, data.header.offsets = [1e-6] * 3, world.points.mean(0)
    data.x, data.y, data.z = world.points.T
    if coloured:
        data.red, data.green, data.blue = world.colors.T.astype(np.uint16) * scale
    data.write(str(tmp_path / f"cloud.{end}"))
    write_navvis(world, tmp_path)
    scene = load(tmp_path, points=f"cloud.{end}")
    torch.testing.assert_close(scene.points, torch.from_numpy(world.points).float(), atol=2e-6, rtol=0)
    grey = "points: the cloud has no colours; grey is used"
    assert torch.equal(scene.point_colors, torch.from_numpy(world.colors)) if coloured else grey in scene.notes
    monkeypatch.setattr(scans_module, "MOST_POINTS", 150)
    monkeypatch.setattr(scans_module, "CHUNK", 64)
    cloud, notes = read_cloud(tmp_path / f"cloud.{end}")
    assert notes == (f"points: one in 3 of cloud.{end}, 134 in all",)
    np.testing.assert_allclose(cloud.points, world.points[::3], atol=2e-6)
    whole = (tmp_path / f"cloud.{end}").read_bytes()
    (tmp_path / f"cloud.{end}").write_bytes(whole[:-900])
    with pytest.raises(DataError, match=rf"cloud.{end} (is cut short, damaged|states 400 points but holds)"):
        read_cloud(tmp_path / f"cloud.{end}")


@pytest.mark.parametrize(
    ("offset", "value"),
    [(100, 2**32 - 1), (96, 2**32 - 1), (294, 2**32 - 1), (310, 0), (324, 2**31 - 1), (-10, 2**31)],
)
def test_numbers_of_a_damaged_laz_file_neither_end_nor_delay_the_process(offset, value, laspy, world, tmp_path):
    data = laspy.LasData(laspy.LasHeader(point_format=2, version="1.2"))
    data.x, data.y, data.z = world.points.T
    data.write(str(tmp_path / "cloud.laz"))
    whole = bytearray((tmp_path / "cloud.laz").read_bytes())
    struct.pack_into("<I", whole, offset, value)  # negative: from the end
    (tmp_path / "cloud.laz").write_bytes(whole)
    with contextlib.suppress(DataError):  # or points that are as many as stated
        assert len(read_cloud(tmp_path / "cloud.laz")[0].points) == len(world.points)


@pytest.fixture
def e57(world: World, tmp_path: Path) -> Path:
    pytest.importorskip("pye57", reason="pye57 is not installed: pip install 'padgs[scanners]'")
    return write_e57(world, tmp_path / "scan.e57")


def write_e57(
    world: World, path: Path, pose: str = "translation", kind: str = "sphericalRepresentation", turn: float = 0.0
) -> Path:
    """Write points with a pose of their own, and panoramas; `pose` and `kind` name the elements."""
    pye57 = importlib.import_module("pye57")
    lib = pye57.libe57
    file = pye57.E57(str(path), mode="w")
    image_file = file.image_file
    rotation, shift = np.array([0.5, 0.5, 0.5, 0.5]), np.array([1.0, 2.0, 3.0])  # x to y to z
    local = (world.points - shift) @ np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    data = {f"cartesian{axis}": column.copy() for axis, column in zip("XYZ", local.T, strict=True)}
    data |= {f"color{name}": c.copy() for name, c in zip(("Red", "Green", "Blue"), world.colors.T, strict=True)}
    file.write_scan_raw(data, rotation=rotation, translation=shift)
    images = file.root["images2D"]
    if not (path.parent / "made").exists():
        write_images(world, path.parent / "made")

    def numbers(parent, name: str, keys: str, values) -> None:
        node = lib.StructureNode(image_file)
        parent.set(name, node)
        for key, value in zip(keys, values, strict=True):
            node.set(key, lib.FloatNode(image_file, float(value)))

    for i, name in enumerate(world.names):
        image, sphere = lib.StructureNode(image_file), lib.StructureNode(image_file)
        images.append(image)
        image.set("name", lib.StringNode(image_file, f"{name}: hall/1"))
        stated = lib.StructureNode(image_file)
        image.set("pose", stated)
        numbers(stated, pose, "xyz", world.centers[i])
        numbers(stated, "rotation", "wxyz", quaternion(PANORAMA.T @ world.rotations[i], inverse=True))
        image.set(kind, sphere)
        if turn:
            sphere.set("imageWidth", lib.IntegerNode(image_file, 64))
            sphere.set("pixelWidth", lib.FloatNode(image_file, turn / 64))
        content = (path.parent / "made" / f"{name}.png").read_bytes()
        blob = lib.BlobNode(image_file, len(content))
        sphere.set("pngImage", blob)
        blob.write(np.frombuffer(content, np.uint8), 0, len(content))
    file.close()
    return path


def test_e57_files_hold_panoramas_poses_and_points(e57: Path, world: World) -> None:
    for path in (e57, e57.parent, e57):
        scene = load(path, split="all")
        assert [view.name for view in scene.train] == [f"{name}_ hall_1" for name in world.names]
        for i, view in enumerate(scene.train):
            rotation, center = torch.from_numpy(world.rotations[i]), torch.from_numpy(world.centers[i])
            torch.testing.assert_close(view.cam_from_world[:3, :3], rotation, atol=1e-12, rtol=0)
            torch.testing.assert_close(view.center, center, atol=1e-12, rtol=0)
            assert torch.equal(view.load_pixels(), torch.from_numpy(world.images[i]))  # type: ignore[misc]
        torch.testing.assert_close(scene.points, torch.from_numpy(world.points).float(), atol=1e-6, rtol=0)
        assert torch.equal(scene.point_colors, torch.from_numpy(world.colors))


def test_another_image_folder_beside_an_e57_file_is_refused(e57: Path) -> None:
    with pytest.raises(DataError, match="data.images=edited: E57 files hold their images; edit those written beside"):
        read(e57, options=DataOptions(images="edited"))


def test_suffixes_are_found_in_any_case_and_hidden_files_are_not_read(e57: Path) -> None:
    folder = e57.with_name("upper")
    folder.mkdir()
    e57.rename(folder / "SCAN.E57")
    (folder / "._SCAN.E57").write_bytes(b"written by macOS")
    assert len(load(folder, split="all").train) == 6


def test_pictures_of_another_export_of_an_e57_file_are_written_again(e57: Path, world: World) -> None:
    read(e57)
    (written,) = [path for path in e57.parent.rglob("*.png") if "pano_00_" in path.name]
    before = written.read_bytes()
    for file in (e57, *(e57.parent / "made").iterdir()):
        file.unlink()
    (e57.parent / "made").rmdir()
    write_e57(replace(world, images=tuple(255 - image for image in world.images)), e57)
    read(e57)
    assert written.read_bytes() == (e57.parent / "made" / "pano_00.png").read_bytes() != before


def test_pictures_that_were_edited_stay(e57: Path) -> None:
    read(e57)
    (written,) = [path for path in e57.parent.rglob("*.png") if "pano_00_" in path.name]
    Image.fromarray(np.full((32, 64, 3), 7, np.uint8)).save(written)
    mark = e57.parent / "scan_images" / ".padgs-written.json"
    for since in (e57.stat().st_mtime - 5, e57.stat().st_mtime + 5):  # a copy of the E57 file may be newer
        os.utime(e57, (since, since))
        scene = load(e57, split="all")
        assert scene.train[0].load_pixels().unique().tolist() == [7]  # type: ignore[misc]
        assert any(f"images: {written.name} differ from those of scan.e57, and stay" in note for note in scene.notes)
        mark.unlink()  # lost: what padgs wrote is not known
    written.unlink()
    assert load(e57, split="all").train[0].load_pixels().unique().numel() > 9  # type: ignore[misc]


def test_e57_files_without_panoramas_or_poses_are_refused(e57: Path, world: World) -> None:
    write_e57(world, e57.with_name("b.e57"), pose="place")
    with pytest.raises(
        DataError, match=r"images2D\[0\] 'pano_00_ hall_1' of .*b.e57 has no pose; export the panoramas"
    ):
        read(e57.with_name("b.e57"))
    write_e57(world, e57.with_name("c.e57"), kind="pinholeRepresentation")
    with pytest.raises(DataError, match=r"c.e57 holds no whole panorama \(images2D with a sphericalRepresentation\)"):
        read(e57.with_name("c.e57"))
    assert len(read_cloud(e57.with_name("c.e57"))[0].points) == 400
    write_e57(world, e57.with_name("d.e57"), turn=np.pi)
    with pytest.raises(DataError, match="d.e57 holds no whole panorama"):
        read(e57.with_name("d.e57"))
    assert len(read(write_e57(world, e57.with_name("e.e57"), turn=2 * np.pi)).frames) == 6
    e57.write_bytes(e57.read_bytes()[:3000])
    with pytest.raises(DataError, match="scan.e57 is cut short, damaged or of another kind"):
        read(e57)
