"""Readers of all formats, on files written by hand: exact poses, points, colours, split and images."""

import json
import os
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.fixtures import (
    WRITERS,
    World,
    paint,
    write_cloud,
    write_colmap_binary,
    write_colmap_text,
    write_openmvg,
    write_transforms,
)

from padgs.data import DataError, load, read
from padgs.data.formats.transforms import transforms_file
from padgs.geometry.panorama import rays

LAYOUTS = {
    **WRITERS,
    "colmap text": write_colmap_text,
    "colmap SPHERICAL": lambda world, folder: write_colmap_text(world, folder, "SPHERICAL"),
    "colmap without rigs": lambda world, folder: write_colmap_binary(world, folder, rigs=False),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_scenes_are_read_exactly(name: str, world: World, tmp_path: Path) -> None:
    folder = tmp_path / "ein Ordner ünd mehr"
    LAYOUTS[name](world, folder)
    scene = load(folder)
    assert scene.notes[0].startswith(f"format: {name.split()[0]}, detected by ")
    assert [view.name for view in scene.train] == list(world.train)
    assert [view.name for view in scene.test] == list(world.test)
    for view in (*scene.train, *scene.test):
        i = world.names.index(view.name)
        rotation, center = torch.from_numpy(world.rotations[i]), torch.from_numpy(world.centers[i])
        torch.testing.assert_close(view.cam_from_world[:3, :3], rotation, atol=1e-12, rtol=0)
        torch.testing.assert_close(view.center, center, atol=1e-12, rtol=0)
        if name != "roam360":  # JPEG
            assert torch.equal(view.load_pixels(), torch.from_numpy(world.images[i]))
    if name == "omniblender":
        assert any("100000 random points" in note for note in scene.notes)
        return
    torch.testing.assert_close(scene.points, torch.from_numpy(world.points).float())
    if name == "openmvg":
        assert "points: the cloud has no colours; grey is used" in scene.notes
    else:
        assert torch.equal(scene.point_colors, torch.from_numpy(world.colors))


@pytest.mark.parametrize("name", WRITERS)
def test_pixels_agree_with_the_poses(name: str, world: World, tmp_path: Path) -> None:
    """Compare pixels with the analytic colours along rays of the loaded poses."""
    WRITERS[name](world, tmp_path / "scene")
    view = load(tmp_path / "scene").train[1]
    directions = rays(view.width, view.height, dtype=torch.float64) @ view.cam_from_world[:3, :3]
    half, center = torch.tensor([2.0, 1.2, 1.6], dtype=torch.float64), view.center
    distance = ((directions.sign() * half - center) / directions).min(-1, keepdim=True).values
    colors = torch.from_numpy(paint((center + distance * directions).numpy()))
    difference = (colors.float() - view.load_pixels().float()).abs()
    assert difference.median() <= (2 if name == "roam360" else 0)


def test_tracks_of_openmvg_reproject(world: World, tmp_path: Path) -> None:
    WRITERS["openmvg"](world, tmp_path / "scene")
    capture = read(tmp_path / "scene")
    assert capture.tracks is not None and len(capture.tracks().pixels) == 2 * len(world.points)


def test_360roam_is_masked_and_reduced(world: World, tmp_path: Path) -> None:
    WRITERS["roam360"](world, tmp_path / "bar")
    scene = load(tmp_path / "bar")
    mask = scene.test[0].mask()
    assert mask is not None and mask[:29].eq(1).all() and mask[30:].eq(0).all()
    assert mask[29, 0].item() == pytest.approx(959 / 1024 * 32 - 29)
    from PIL import Image

    for path in (tmp_path / "bar" / "images").iterdir():
        Image.new("RGB", (4096, 2048)).save(path)
    assert load(tmp_path / "bar").train[0].width == 2048
    assert load(tmp_path / "bar", width=512).train[0].width == 512


def test_ricoh360_reads_its_mask(world: World, tmp_path: Path) -> None:
    WRITERS["ricoh360"](world, tmp_path / "bricks")
    scene = load(tmp_path / "bricks")
    assert "mask" not in [view.name for view in (*scene.train, *scene.test)]
    assert scene.train[0].mask().eq(1).all()  # type: ignore[union-attr]
    (tmp_path / "bricks" / "imgs").rename(tmp_path / "bricks" / "images")
    (tmp_path / "bricks" / "images" / "mask.png").rename(tmp_path / "bricks" / "images" / "Mask.PNG")
    assert load(tmp_path / "bricks").train[0].mask() is not None


def test_extrinsics_are_of_poses(world: World, tmp_path: Path) -> None:
    WRITERS["released"](world, tmp_path / "a")
    before = load(tmp_path / "a").fingerprint
    views, poses = (json.loads((tmp_path / "a" / f"data_{name}.json").read_text()) for name in ("views", "extrinsics"))
    for view in views["views"]:
        view["value"]["ptr_wrapper"]["data"]["id_pose"] += 100
    for pose in poses["extrinsics"]:
        pose["key"] += 100
    (tmp_path / "a" / "data_views.json").write_text(json.dumps(views))
    (tmp_path / "a" / "data_extrinsics.json").write_text(json.dumps(poses))
    assert load(tmp_path / "a").fingerprint == before


def test_names_that_share_a_file_of_results_are_refused(world: World, tmp_path: Path) -> None:
    whole = _written(world, tmp_path)
    for frame, name in zip(whole["frames"], ("images/a/b.png", "images/a-b.png"), strict=False):
        (tmp_path / "scene" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "scene" / frame["file_path"]).rename(tmp_path / "scene" / name)
        frame["file_path"] = name
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(whole))
    with pytest.raises(DataError, match="'a/b.png' and 'a-b.png' would share one name"):
        load(tmp_path / "scene", split="every")


def test_pairs_of_transforms_files(world: World, tmp_path: Path) -> None:
    """transforms_train.json and transforms_test.json, file names without extension, as Blender's exporters write."""
    whole = _written(world, tmp_path)
    for side, names in (("train", world.train), ("test", world.test)):
        frames = [frame for frame in whole["frames"] if Path(frame["file_path"]).stem in names]
        frames = [{**frame, "file_path": "./" + frame["file_path"].removesuffix(".png")} for frame in frames]
        part = {"camera_model": "EQUIRECTANGULAR", "frames": frames}
        (tmp_path / "scene" / f"transforms_{side}.json").write_text(json.dumps(part))
    for path in (tmp_path / "scene").glob("*.txt"):
        path.unlink()
    file = tmp_path / "scene" / "transforms.json"
    bare = {**whole, "frames": [{**frame, "file_path": "./" + frame["file_path"][:-4]} for frame in whole["frames"]]}
    bare = {key: value for key, value in bare.items() if not key.endswith("_filenames")}
    file.write_text(json.dumps(bare))
    assert [view.name for view in load(tmp_path / "scene").test] == list(world.test)
    file.write_text(json.dumps({**bare, "test_filenames": ["images/pano_00"]}))
    both = load(tmp_path / "scene")
    assert [view.name for view in both.test] == ["pano_00"]
    assert "not used: transforms_train.json, transforms_test.json; transforms.json has the views" in both.notes
    file.unlink()
    scene = load(tmp_path / "scene")
    assert [view.name for view in scene.test] == list(world.test) and len(scene.points) == len(world.points)


def test_transforms_files_for_validation_and_alone(world: World, tmp_path: Path) -> None:
    whole = _written(world, tmp_path)
    scene = tmp_path / "scene"
    (scene / "transforms.json").unlink()
    halves = {"train": whole["frames"][:4], "val": whole["frames"][4:]}
    for side, frames in halves.items():
        (scene / f"transforms_{side}.json").write_text(json.dumps({**whole, "frames": frames}))
    names = [Path(frame["file_path"]).stem for frame in whole["frames"]]
    assert [view.name for view in load(scene).test] == names[4:]
    (scene / "transforms_test.json").write_text(json.dumps({**whole, "frames": whole["frames"][3:4]}))
    (scene / "transforms_train.json").write_text(json.dumps({**whole, "frames": whole["frames"][:3]}))
    assert "transforms_val.json is not used: transforms_test.json has the test views" in load(scene).notes
    (scene / "transforms_test.json").unlink()
    (scene / "transforms_train.json").write_text(json.dumps({**whole, "frames": whole["frames"]}))
    (scene / "transforms_val.json").unlink()
    for side in ("train", "test"):
        (scene / f"{side}.txt").unlink(missing_ok=True)
    assert [view.name for view in load(scene).test] == names[:1]


def test_transforms_without_test_names_and_with_models_in_small_letters(world: World, tmp_path: Path) -> None:
    whole = _written(world, tmp_path)
    paths = [frame["file_path"] for frame in whole["frames"]]
    lists = {"train_filenames": paths[:4], "val_filenames": paths[4:], "test_filenames": []}
    changed = {**whole, **lists, "camera_model": "equirectangular", "ply_file_path": "absent.ply"}
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(changed))
    scene = load(tmp_path / "scene", points="random")
    assert [view.name for view in scene.test] == [Path(path).stem for path in paths[4:]]
    with pytest.raises(DataError, match=r"absent.ply does not exist; set data.points to a .* file, or to random"):
        load(tmp_path / "scene")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_byte_order_marks(encoding: str, world: World, tmp_path: Path) -> None:
    _written(world, tmp_path)
    file = tmp_path / "scene" / "transforms.json"
    file.write_text(file.read_text(), encoding=encoding)
    assert len(read(tmp_path / "scene").frames) == 6


def test_pipes_in_place_of_files(world: World, tmp_path: Path) -> None:
    _written(world, tmp_path)
    (tmp_path / "scene" / "transforms.json").unlink()
    os.mkfifo(tmp_path / "scene" / "transforms.json")
    with pytest.raises(DataError, match="transforms.json cannot be read: it is no regular file"):
        load(tmp_path / "scene")


def test_masks_named_in_transforms(world: World, tmp_path: Path) -> None:
    from PIL import Image

    def name_masks(meta: dict[str, Any]) -> None:
        for frame in meta["frames"][:2]:
            frame["mask_path"] = "masks/" + Path(frame["file_path"]).name

    _written(world, tmp_path, name_masks)
    (tmp_path / "scene" / "masks").mkdir()
    for name in world.names[:2]:
        Image.new("L", (64, 32), 255).save(tmp_path / "scene" / "masks" / f"{name}.png")
    views: dict[str, Any] = {view.name: view for view in load(tmp_path / "scene", split="all").train}
    assert [views[name].mask() is not None for name in world.names] == [True, True, False, False, False, False]


def test_several_formats_in_one_folder(world: World, tmp_path: Path) -> None:
    WRITERS["colmap"](world, tmp_path / "scene")
    _written(world, tmp_path / "other")
    (tmp_path / "scene" / "transforms.json").write_text((tmp_path / "other" / "scene" / "transforms.json").read_text())
    (tmp_path / "scene" / "sparse_pc.ply").write_bytes((tmp_path / "other" / "scene" / "sparse_pc.ply").read_bytes())
    note = load(tmp_path / "scene").notes[0]
    assert note.startswith("format: colmap") and "also present, not used: transforms.json" in note
    assert load(tmp_path / "scene", "transforms").train[0].name == "pano_00"
    assert load(tmp_path / "scene" / "transforms.json").notes[0].startswith("format: transforms")
    scene = str(tmp_path / "scene")
    assert transforms_file(scene, "auto") is None and transforms_file(None, "auto") is None
    assert transforms_file(scene, "nerfstudio") == tmp_path / "scene" / "transforms.json"


def test_a_list_of_names_is_no_colmap_model(world: World, tmp_path: Path) -> None:
    _written(world, tmp_path)
    (tmp_path / "scene" / "images.txt").write_text("\n".join(f"{name}.png" for name in world.names))
    assert load(tmp_path / "scene").notes[0].startswith("format: transforms")


@pytest.mark.parametrize("written", [write_colmap_text, write_colmap_binary])
def test_the_part_with_most_images_is_taken(written: Any, world: World, tmp_path: Path) -> None:
    written(world, tmp_path)
    few = next(tmp_path.glob("sparse/0/images.*"))
    part = tmp_path / "sparse" / "1"
    shutil.copytree(few.parent, part)
    if few.suffix == ".txt":  # two images with many observations
        lines = [line for line in few.read_text().splitlines() if not line.startswith("#")]
        lines[1] = lines[3] = " ".join(["1.5 2.5 -1"] * 5000)
        few.write_text("\n".join(lines[:4]) + "\n")
    else:
        few.write_bytes(struct.pack("<Q", 2) + few.read_bytes()[8:] + bytes(100_000))
    note = next(note for note in load(tmp_path).notes if "several parts" in note)
    assert note == "the model has several parts; the largest, 1, is used, not 0"


def test_errors_name_the_other_formats_of_the_folder(world: World, tmp_path: Path) -> None:
    _written(world, tmp_path)
    write_colmap_text(world, tmp_path / "other")
    shutil.copytree(tmp_path / "other" / "sparse", tmp_path / "scene" / "sparse")
    cameras = tmp_path / "scene" / "sparse" / "0" / "cameras.txt"
    also = r".*also present, not used: transforms.json; set data.format to choose"
    for text, error in ((f"1 PINHOLE {world.size[0]} {world.size[1]} 30 30 32 16\n", "other cameras"), ("x\n", "")):
        cameras.write_text(text)
        with pytest.raises(DataError, match=error + also):
            load(tmp_path / "scene")


def test_cameras_of_openmvg_that_no_view_uses_do_not_matter(world: World, tmp_path: Path) -> None:
    write_openmvg(world, tmp_path)
    file = tmp_path / "sfm_data.json"
    data = json.loads(file.read_text())
    value = {"polymorphic_id": 2147483650, "polymorphic_name": "pinhole", "ptr_wrapper": {}}
    data["intrinsics"] += [{"key": 7, "value": value}, {"key": 8, "value": {**value, "polymorphic_id": 2}}]
    del data["intrinsics"][-1]["value"]["polymorphic_name"]  # named where it first occurs
    file.write_text(json.dumps(data))
    assert len(load(tmp_path).train) == len(world.train)
    for key in (7, 8):
        data["views"][0]["value"]["ptr_wrapper"]["data"]["id_intrinsic"] = key
        file.write_text(json.dumps(data))
        with pytest.raises(DataError, match="holds a 'pinhole' camera; only spherical"):
            load(tmp_path)


def _other_camera(data: Any, format: str) -> None:
    """Make the first image one of another camera."""
    if format == "transforms":
        data["frames"][0]["camera_model"] = "OPENCV"
    elif format == "opensfm":
        data[1]["cameras"]["phone"] = {"projection_type": "perspective"}
        next(iter(data[1]["shots"].values()))["camera"] = "phone"
    else:
        value = {"polymorphic_id": 2147483650, "polymorphic_name": "pinhole", "ptr_wrapper": {}}
        data["intrinsics"].append({"key": 7, "value": value})
        data["views"][0]["value"]["ptr_wrapper"]["data"]["id_intrinsic"] = 7


@pytest.mark.parametrize(
    ("format", "file"),
    [("transforms", "transforms.json"), ("opensfm", "reconstruction.json"), ("openmvg", "sfm_data.json")],
)
def test_photographs_beside_panoramas_are_left_out_on_request(format: str, file: str, world: World, tmp_path: Path):
    WRITERS[format](world, tmp_path)
    data = json.loads((tmp_path / file).read_text())
    _other_camera(data, format)
    (tmp_path / file).write_text(json.dumps(data))
    with pytest.raises(DataError, match="; leave out images of other cameras with data.cameras=panoramas"):
        load(tmp_path)
    scene = load(tmp_path, cameras="panoramas", split="all")
    assert len(scene.train) == len(world.names) - 1 and world.names[0] not in [view.name for view in scene.train]
    assert any("1 of 6 images are no panoramas; they are left out" in note for note in scene.notes)


def test_lists_may_name_photographs_that_are_left_out(world: World, tmp_path: Path) -> None:
    WRITERS["opensfm"](world, tmp_path)
    data = json.loads((tmp_path / "reconstruction.json").read_text())
    _other_camera(data, "opensfm")
    (tmp_path / "reconstruction.json").write_text(json.dumps(data))
    (tmp_path / "train.txt").write_text("pano_00\npano_01\npano_02\n")
    (tmp_path / "test.txt").write_text("pano_03\n")
    scene = load(tmp_path, cameras="panoramas")
    assert [view.name for view in scene.train] == ["pano_01", "pano_02"]


def test_points_of_opensfm_without_colours_do_not_hide_those_with_colours(world: World, tmp_path: Path) -> None:
    WRITERS["opensfm"](world, tmp_path)
    data = json.loads((tmp_path / "reconstruction.json").read_text())
    del data[1]["points"]["0"]["color"]
    (tmp_path / "reconstruction.json").write_text(json.dumps(data))
    assert torch.equal(load(tmp_path).point_colors, torch.from_numpy(world.colors[1:]))


def test_a_missing_image_folder_is_named_in_every_format(world: World, tmp_path: Path) -> None:
    for name, write in WRITERS.items():
        write(world, tmp_path / name)
        with pytest.raises(DataError, match="data.images=nope: there is no folder"):
            load(tmp_path / name, images="nope")


def test_absolute_masks_do_not_matter_if_masks_are_not_used(world: World, tmp_path: Path) -> None:
    def masked(meta: dict[str, Any]) -> None:
        meta |= {"frames": [{**frame, "mask_path": "/data/masks/x.png"} for frame in meta["frames"]]}

    _written(world, tmp_path, masked)
    with pytest.raises(DataError, match="names must be relative and stay inside the folder: put it there"):
        load(tmp_path / "scene")
    assert load(tmp_path / "scene", mask="none").train[0].mask() is None


def test_empty_optional_names_are_as_good_as_none(world: World, tmp_path: Path) -> None:
    def emptied(meta: dict[str, Any]) -> None:
        meta |= {"ply_file_path": "", "frames": [{**frame, "mask_path": ""} for frame in meta["frames"]]}

    _written(world, tmp_path, emptied)
    scene = load(tmp_path / "scene")
    assert scene.train[0].mask() is None and len(scene.points) == len(world.points), "those of sparse_pc.ply"


def test_depths_of_nerfstudio_are_not_read_and_it_is_said(world: World, tmp_path: Path) -> None:
    _written(world, tmp_path, lambda meta: [frame.update(depth_file_path="d.png") for frame in meta["frames"]])
    assert any(note.startswith("depth: depth_file_path is not read; ") for note in load(tmp_path / "scene").notes)


def _written(
    world: World, folder: Path, change: Callable[[dict[str, Any]], object] = lambda meta: None
) -> dict[str, Any]:
    write_transforms(world, folder / "scene")
    path = folder / "scene" / "transforms.json"
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))
    return meta


def test_the_cameras_in_a_cloud_of_openmvg_are_left_out(world: World, tmp_path: Path) -> None:
    """openMVG_main_ComputeSfM_DataColor adds a green point at each camera."""
    write_openmvg(world, tmp_path)
    green = np.tile(np.array([0, 255, 0], np.uint8), (len(world.centers) + 1, 1))
    points = np.concatenate((world.points, world.centers.round(5), [[0.25, 0.5, 0.125]]))
    write_cloud(replace(world, points=points, colors=np.concatenate((world.colors, green))), tmp_path / "colorized.ply")
    scene = load(tmp_path)
    expected = np.concatenate((world.points, [[0.25, 0.5, 0.125]]))  # a green leaf stays
    torch.testing.assert_close(scene.points, torch.from_numpy(expected).float(), atol=1e-5, rtol=0)


@pytest.mark.parametrize("turned", [False, True])
def test_points_for_lichtfeld_studio_are_turned_back(turned: bool, world: World, tmp_path: Path) -> None:
    """It turns the cameras of panoramas by 180 degrees about y, and not the points of pointcloud.ply."""
    write_transforms(world, tmp_path)
    cloud = tmp_path / "pointcloud.ply"
    described = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / described.pop("ply_file_path")).unlink()
    (tmp_path / "transforms.json").write_text(json.dumps(described))
    write_cloud(replace(world, points=world.points * ([-1, 1, -1] if turned else [1, 1, 1])), cloud)
    scene = load(tmp_path)
    torch.testing.assert_close(scene.points, torch.from_numpy(world.points).float(), atol=1e-5, rtol=0)
    assert any(("turned by 180 degrees" in note) == turned for note in scene.notes if note.startswith("the points are"))
    for points in ("pointcloud.ply", str(cloud)):
        named = load(tmp_path, points=points)
        assert torch.equal(named.points, scene.points) and named.fingerprint == scene.fingerprint
    (tmp_path / "elsewhere").mkdir()
    other = cloud.rename(tmp_path / "elsewhere.ply")  # somebody's own cloud, in the world of the poses
    assert torch.equal(load(tmp_path, points=str(other)).points, scene.points) != turned
