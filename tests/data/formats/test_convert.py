"""Conversion of every format to every other, and of nothing partially."""

import errno
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.fixtures import WRITERS, World, write_cloud, write_colmap_text

from padgs.cli.convert import FORMATS
from padgs.data import DataError, DataOptions, load, read
from padgs.data.capture import Frame, view_name
from padgs.data.cloud import read_ply
from padgs.data.formats import writers
from padgs.data.formats.convert import convert
from padgs.scene import Scene


@pytest.mark.parametrize(
    ("source", "to"),
    [*((source, "released") for source in WRITERS), *(("colmap", to) for to in writers.WRITERS if to != "nerfstudio")],
)
def test_round_trip(source: str, to: str, world: World, tmp_path: Path) -> None:
    """Convert a data set written by hand, and compare both as loaded."""
    WRITERS[source](world, tmp_path / "in")
    if source == "omniblender":  # has none of its own
        write_cloud(world, tmp_path / "in" / "pcd.ply")
    convert(tmp_path / "in", tmp_path / "out put", to)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "out put"]
    scene, truth = load(tmp_path / "out put"), load(tmp_path / "in")
    assert scene.notes[0].startswith(f"format: {to}")
    _same(scene, truth, world)


def test_openmvg_has_an_intrinsic_for_each_size(world: World, tmp_path: Path) -> None:
    sizes = [(64, 32), (64, 32), (128, 64)]
    frames = tuple(Frame(f"{k}.png", tmp_path, torch.eye(4).double(), *size) for k, size in enumerate(sizes))
    writers.write_openmvg(writers.Content(frames, None, None, {}), tmp_path)
    data = json.loads((tmp_path / "sfm_data.json").read_text())
    by_key = {one["key"]: one["value"]["ptr_wrapper"]["data"]["value0"] for one in data["intrinsics"]}
    views = [view["value"]["ptr_wrapper"]["data"] for view in data["views"]]
    assert [(by_key[view["id_intrinsic"]]["width"], by_key[view["id_intrinsic"]]["height"]) for view in views] == sizes
    wrappers = [one["value"]["ptr_wrapper"]["id"] for name in ("views", "intrinsics") for one in data[name]]
    assert len({*wrappers}) == 5 and [*by_key] == [0, 1]


@pytest.mark.parametrize("points", ["mine.ply", "random"])
def test_points_far_from_the_origin_stay_with_the_poses(points: str, world: World, tmp_path: Path) -> None:
    far = np.array([500_000.0, 4_000_000.0, 100.0])
    WRITERS["colmap"](replace(world, centers=world.centers + far, points=world.points + far), tmp_path / "in")
    write_cloud(replace(world, points=world.points + far), tmp_path / "in" / "mine.ply")
    truth = convert(tmp_path / "in", tmp_path / "out", "transforms", options=DataOptions(points=points))
    scene = load(tmp_path / "out")
    torch.testing.assert_close(scene.origin, truth.origin)
    torch.testing.assert_close(scene.points, truth.points, atol=1e-3 if points == "random" else 0.5, rtol=0)


def test_help_lists_the_formats_and_nerfstudio_is_one(world: World, tmp_path: Path) -> None:
    assert set(re.findall(r"\w+", FORMATS)) - {"or"} == writers.WRITERS.keys()
    WRITERS["colmap"](world, tmp_path / "in")
    convert(tmp_path / "in", tmp_path / "out", "nerfstudio")
    assert load(tmp_path / "out", "nerfstudio").notes == load(tmp_path / "out", "transforms").notes


def test_nerfstudio_finds_what_it_needs(world: World, tmp_path: Path) -> None:
    """A focal length, which for a panorama is the height, and masks of all frames or none."""
    WRITERS["transforms"](world, tmp_path / "in")
    width, height = world.size
    hidden = np.full((height, width), 255, np.uint8)
    hidden[-4:] = 0
    Image.fromarray(hidden).save(tmp_path / "in" / "mask.png")
    convert(tmp_path / "in", tmp_path / "out", "nerfstudio")
    written = json.loads((tmp_path / "out" / "transforms.json").read_text())
    for frame in written["frames"]:
        assert (frame["fl_x"], frame["fl_y"], frame["cx"], frame["cy"]) == (height, height, width / 2, height / 2)
        assert frame["mask_path"] == "mask.png"
    assert written["val_filenames"] == written["test_filenames"] != []
    assert load(tmp_path / "out").train[0].mask().mean() == 1 - 4 / height  # type: ignore[union-attr]
    (tmp_path / "in" / "mask.png").unlink()
    (tmp_path / "in" / "masks").mkdir()
    Image.fromarray(hidden).save(tmp_path / "in" / "masks" / f"{world.names[0]}.png")
    convert(tmp_path / "in", tmp_path / "some", "nerfstudio")
    assert "mask_path" not in (tmp_path / "some" / "transforms.json").read_text()
    assert load(tmp_path / "some").fingerprint == load(tmp_path / "in").fingerprint


def test_points_without_colours_get_some_for_released_programs(world: World, tmp_path: Path) -> None:
    WRITERS["openmvg"](world, tmp_path / "in")
    assert not (tmp_path / "in" / "colorized.ply").exists()
    convert(tmp_path / "in", tmp_path / "out", "released")
    cloud = read_ply(tmp_path / "out" / "pcd.ply")
    assert cloud.colors is not None and len(cloud.colors) == len(world.points)


def test_tracks_are_converted(world: World, tmp_path: Path) -> None:
    WRITERS["colmap"](world, tmp_path / "a")
    convert(tmp_path / "a", tmp_path / "b", "openmvg", options=DataOptions(width=32))
    (tmp_path / "b" / "colorized.ply").unlink()  # its points are in another order for all that openmvg promises
    convert(tmp_path / "b", tmp_path / "c", "colmap")
    before, after = read(tmp_path / "a").tracks, read(tmp_path / "c").tracks
    assert before is not None and after is not None
    first, last = before(), after()
    keys = [tracks.frame * 1000 + tracks.point for tracks in (first, last)]
    pixels = [tracks.pixels[key.argsort()] for tracks, key in zip((first, last), keys, strict=True)]
    torch.testing.assert_close(pixels[0], 2 * pixels[1], atol=1e-9, rtol=0)


def test_masks_per_image_and_the_rule_of_360roam(world: World, tmp_path: Path) -> None:
    WRITERS["roam360"](world, tmp_path / "a")
    convert(tmp_path / "a", tmp_path / "b", "transforms")
    assert (tmp_path / "b" / "mask.png").is_file()
    mask, rule = load(tmp_path / "b").train[0].mask(), load(tmp_path / "a").train[0].mask()
    torch.testing.assert_close(mask, rule, atol=0.5 / 255, rtol=0)
    WRITERS["colmap"](world, tmp_path / "c")
    (tmp_path / "c" / "masks").mkdir()
    Image.new("L", (64, 32), 100).save(tmp_path / "c" / "masks" / "pano_02.png")
    convert(tmp_path / "c", tmp_path / "d", "released")
    found = {view.name: view.mask() for view in load(tmp_path / "d").train}
    assert [name for name, mask in found.items() if mask is not None] == ["pano_02"]


@pytest.mark.parametrize("rows", [0, 3])
def test_masks_of_narrow_pictures_are_named_for_training(rows: int, narrow: Path, tmp_path: Path) -> None:
    if rows:  # of one picture, are hidden in addition
        (narrow / "masks").mkdir()
        mask = Image.fromarray(np.repeat(np.uint8([255, 0]), [96 * (32 - rows), 96 * (16 + rows)]).reshape(48, 96))
        mask.save(narrow / "masks" / "pano_00.png")
    name = "masks" if rows else "mask.png"
    scene = convert(narrow, tmp_path / "out", "transforms")
    note = f"mask: pictures show small parts of the sphere; train on {tmp_path / 'out'} with data.mask={name}"
    assert [one for one in scene.notes if "train on" in one] == [note]
    with pytest.raises(
        DataError, match=rf"the masks hide 83% of the sphere, .*; if that is meant, set data.mask={name}"
    ):
        load(tmp_path / "out")
    written = load(tmp_path / "out", mask=name)
    for view, before in zip(written.train, scene.train, strict=True):
        assert torch.equal(view.mask(), before.mask()) and view.mask().sum() == 32 * (
            16 - rows * (view.name == "pano_00")
        )


def test_masks_that_hide_less_are_not_named_for_training(world: World, tmp_path: Path) -> None:
    WRITERS["roam360"](world, tmp_path / "a")
    assert not any("data.mask" in note for note in convert(tmp_path / "a", tmp_path / "b", "transforms").notes)


def test_reducing(world: World, tmp_path: Path) -> None:
    WRITERS["colmap"](world, tmp_path / "a")
    convert(tmp_path / "a", tmp_path / "b", "colmap", options=DataOptions(width=32))
    small, reduced = load(tmp_path / "b"), load(tmp_path / "a", width=32)
    assert torch.equal(small.test[1].image(), reduced.test[1].image())
    assert read(tmp_path / "b").frames[0].width == 32


def test_nested_images(world: World, tmp_path: Path) -> None:
    WRITERS["transforms"](world, tmp_path / "a")
    text = (tmp_path / "a" / "transforms.json").read_text()
    for name, folder in (("pano_00", "eins"), ("pano_01", "zwei ü")):
        (tmp_path / "a" / "images" / folder).mkdir()
        (tmp_path / "a" / "images" / f"{name}.png").rename(tmp_path / "a" / "images" / folder / f"{name}.png")
        text = text.replace(f"images/{name}.png", f"images/{folder}/{name}.png")
    (tmp_path / "a" / "transforms.json").write_text(text)
    (tmp_path / "a" / "masks" / "zwei ü").mkdir(parents=True)
    Image.new("L", (64, 32), 100).save(tmp_path / "a" / "masks" / "zwei ü" / "pano_01.png")
    convert(tmp_path / "a", tmp_path / "b", "colmap")
    convert(tmp_path / "b", tmp_path / "c", "released")
    convert(tmp_path / "c", tmp_path / "d", "transforms")
    scene = load(tmp_path / "d")
    views = {view.name: view.mask() for view in (*scene.train, *scene.test)}
    assert {"eins/pano_00", "zwei ü/pano_01"} <= views.keys()
    assert [name for name, mask in views.items() if mask is not None] == ["zwei ü/pano_01"]


def test_images_in_one_subfolder_keep_names_masks_and_depth(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path / "a")
    for name in world.names:
        (tmp_path / "a" / "images" / "pano").mkdir(exist_ok=True)
        (tmp_path / "a" / "images" / f"{name}.png").rename(tmp_path / "a" / "images" / "pano" / f"{name}.png")
    model = tmp_path / "a" / "sparse" / "0" / "images.txt"
    model.write_text(model.read_text().replace("pano_", "pano/pano_"))
    for kind in ("masks", "depths"):
        (tmp_path / "a" / kind / "pano").mkdir(parents=True)
    Image.new("L", (64, 32), 100).save(tmp_path / "a" / "masks" / "pano" / "pano_01.png")
    np.save(tmp_path / "a" / "depths" / "pano" / "pano_01.npy", np.full((32, 64), 2.0, np.float32))
    (tmp_path / "a" / "depths" / "depth.json").write_text('{"measure": "ray", "unit": 1}')
    for to in ("transforms", "colmap", "openmvg", "opensfm"):
        convert(tmp_path / "a", tmp_path / to, to, options=DataOptions(split="every"))
        scene = load(tmp_path / to, split="every")
        views = {view.name: view for view in (*scene.train, *scene.test)}
        assert [*views] == [f"pano/{name}" for name in (*world.names[1:], world.names[0])], to
        assert [name for name, view in views.items() if view.mask() is not None] == ["pano/pano_01"], to
        assert [name for name, view in views.items() if view.load_depth is not None] == ["pano/pano_01"], to


def test_a_capture_that_is_all_for_training_says_so(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path / "a")
    scene = convert(tmp_path / "a", tmp_path / "b", "colmap", options=DataOptions(split="all"))
    assert any("train on" in note and note.endswith("with data.split=all") for note in scene.notes)
    assert len(load(tmp_path / "b", split="all").train) == len(world.names)


def test_a_full_disk_leaves_no_files(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    WRITERS["colmap"](world, tmp_path / "in")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setitem(writers.WRITERS, "released", full)
    with pytest.raises(DataError, match=r"cannot write .*out \(No space left on device\); nothing was written"):
        convert(tmp_path / "in", tmp_path / "out", "released")
    assert [path.name for path in tmp_path.iterdir()] == ["in"]

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "copyfile", interrupted)
    with pytest.raises(KeyboardInterrupt):
        convert(tmp_path / "in", tmp_path / "out", "colmap")
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize(
    ("name", "to"),
    [
        *((name, "released") for name in (" lead.png", "trail .png", "\u3000x.png")),
        *((" lead.png", to) for to in ("openmvg", "opensfm", "colmap", "transforms")),
    ],
)
def test_names_with_outer_spaces(name: str, to: str, world: World, tmp_path: Path) -> None:
    WRITERS["transforms"](world, tmp_path / "in")
    text = (tmp_path / "in" / "transforms.json").read_text()
    (tmp_path / "in" / "images" / "pano_01.png").rename(tmp_path / "in" / "images" / name)
    (tmp_path / "in" / "transforms.json").write_text(text.replace("pano_01.png", name))
    for file in (tmp_path / "in").glob("*.txt"):
        file.write_text(file.read_text().replace("pano_01", view_name(name)))
    convert(tmp_path / "in", tmp_path / "out", to)
    split = [[view.name for view in side] for side in (load(tmp_path / "out").train, load(tmp_path / "out").test)]
    assert split == [[view.name for view in side] for side in (load(tmp_path / "in").train, load(tmp_path / "in").test)]
    (tmp_path / "in" / "images" / name).rename(tmp_path / "in" / "images" / "x\ny.png")
    (tmp_path / "in" / "transforms.json").write_text(text.replace("pano_01.png", "x\\ny.png"))
    for file in (tmp_path / "in").glob("*.txt"):
        file.unlink()
    if to != "transforms":
        with pytest.raises(DataError, match="has a line break, and a list has one name a line; rename the image"):
            convert(tmp_path / "in", tmp_path / "out 2", to, options=DataOptions(split="every", test_every=2))


def test_convert_refuses_invalid_calls(world: World, tmp_path: Path, monkeypatch) -> None:
    WRITERS["omniblender"](world, tmp_path / "in")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with pytest.raises(DataError, match="full exists; nothing is overwritten"):
        convert(tmp_path / "in", tmp_path / "full", "colmap")
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    with pytest.raises(ValueError, match=r"\. is the working folder or a root, which is not replaced; name a new one"):
        convert(tmp_path / "in", Path(), "colmap")
    with pytest.raises(ValueError, match=r"empty is the working folder or a root, which is not replaced"):
        convert(tmp_path / "in", Path.cwd(), "colmap")
    (tmp_path / "empty").rmdir()
    with pytest.raises(ValueError, match="unknown format 'ply'; known: colmap, transforms"):
        convert(tmp_path / "in", tmp_path / "out", "ply")
    with pytest.raises(DataError, match="there is no point cloud, and a COLMAP model needs one"):
        convert(tmp_path / "in", tmp_path / "out", "colmap")
    (tmp_path / "in" / "images" / "pano_03.png").write_bytes(b"no image")
    with pytest.raises(DataError, match="pano_03.png is not an image"):
        convert(tmp_path / "in", tmp_path / "out", "transforms")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["full", "in"]


def _same(scene: Scene, truth: Scene, world: World) -> None:
    assert [view.name for view in scene.train] == list(world.train)
    assert [view.name for view in scene.test] == list(world.test)
    for view, expected in zip((*scene.train, *scene.test), (*truth.train, *truth.test), strict=True):
        torch.testing.assert_close(view.cam_from_world, expected.cam_from_world, atol=1e-12, rtol=0)
        assert torch.equal(view.load_pixels(), expected.load_pixels())  # type: ignore[misc]
    assert torch.equal(scene.points, truth.points)
    assert torch.equal(scene.point_colors, truth.point_colors)
