"""Depth maps: stand-ins for OB3D and TartanAir-V2 in their exact layout, folders of one's own, and their scores."""

import json
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from support.fixtures import HALF, World, write_cloud, write_colmap_text

from padgs.checks import lookup
from padgs.data import DATASETS, DataError, DataOptions, load
from padgs.data.capture import Capture, DepthMeaning, Frame
from padgs.data.check import check
from padgs.data.depths import Depth, _depth_files, _exr
from padgs.data.formats.convert import convert
from padgs.evaluation.protocols import PROTOCOLS
from padgs.evaluation.scoring import score
from padgs.geometry.camera import Pinhole
from padgs.geometry.panorama import rays
from padgs.render import Rendering
from padgs.scene import View
from padgs.training.targets import Targets

LEFT_AHEAD = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # body from camera, as COLMAP's benchmark states it


def truth(world: World, i: int) -> torch.Tensor:
    """Return the distance [H, W] float64 from a camera to the box."""
    width, height = world.size
    directions = rays(width, height, dtype=torch.float64) @ torch.from_numpy(world.rotations[i])
    center = torch.from_numpy(world.centers[i])
    return ((directions.sign() * torch.from_numpy(HALF) - center) / directions).amin(-1)


def write_ob3d(world: World, folder: Path, depths: bool) -> None:
    for name in ("cameras", "images", "sparse", *(["depths"] if depths else [])):
        (folder / name).mkdir(parents=True)
    write_cloud(world, folder / "sparse" / "sparse.ply")
    width, height = world.size
    for i, image in enumerate(world.images):
        Image.fromarray(image).save(folder / "images" / f"{i:05d}_rgb.png")
        pose = {"rotation": world.rotations[i].tolist(), "translation": world.translations[i].tolist()}
        lens = {"focal": height, "cx": width / 2, "cy": height / 2}
        camera = [{"id": i, "width": width, "height": height, "intrinsics": lens, "extrinsics": pose}]
        (folder / "cameras" / f"{i:05d}_cam.json").write_text(json.dumps(camera))
        if depths:
            import OpenEXR

            depth = truth(world, i).float().numpy()
            depth[:2] = 1e10  # Blender's sky
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            OpenEXR.File(header, {"RGB": np.stack([depth] * 3, -1)}).write(str(folder / f"depths/{i:05d}_depth.exr"))
    (folder / "train.txt").write_text("0\n2\n3\n")
    (folder / "test.txt").write_text("00004\n")


@pytest.mark.parametrize("depths", [False, True])
def test_ob3d(depths: bool, world: World, tmp_path: Path):
    if depths and not find_spec("OpenEXR"):
        write_colmap_text(world, tmp_path / "a")
        (tmp_path / "a" / "depths").mkdir()
        (tmp_path / "a" / "depths" / f"{world.names[0]}.exr").write_bytes(b"v/1\x01")
        (tmp_path / "a" / "depths" / "depth.json").write_text('{"measure": "ray"}')
        with pytest.raises(DataError, match=r"needs OpenEXR, which .*padgs\[exr\]"):
            load(tmp_path / "a")
        return
    folder = tmp_path / "bistro" / "Non-Egocentric"
    write_ob3d(world, folder, depths)
    scene = load(folder)
    assert scene.name == "bistro_Non-Egocentric" and scene.notes[0].startswith("format: ob3d, ")
    assert [view.name for view in scene.train] == ["00000_rgb", "00002_rgb", "00003_rgb"]
    assert [view.name for view in scene.test] == ["00004_rgb"] and len(scene.points) == len(world.points)
    view = scene.test[0]
    torch.testing.assert_close(view.center, torch.from_numpy(world.centers[4]), atol=1e-12, rtol=0)
    assert torch.equal(view.load_pixels(), torch.from_numpy(world.images[4]))
    if depths:
        depth = view.load_depth()
        assert torch.isinf(depth[:2]).all() and torch.equal(depth[2:], truth(world, 4)[2:].float())
        assert "depth: 6 of 6 views, 64x32, distance along the ray in steps of 1 world units (by OB3D)" in scene.notes
    else:
        assert view.load_depth is None
    (folder / "train.txt").write_text("7\n")
    with pytest.raises(DataError, match="the train list .* images that do not exist: '00007_rgb.png'"):
        load(folder)
    (folder / "train.txt").unlink()
    (folder / "Train.txt").write_text("0\nimages/00002_rgb.png\n00003_rgb\n")
    (folder / "cameras" / "._00000_cam.json").write_bytes(b"\0\5\x16\7")  # of macOS
    assert [view.name for view in load(folder).train] == ["00000_rgb", "00002_rgb", "00003_rgb"]
    (folder / "sparse" / "sparse.ply").write_bytes(b"damaged")
    with pytest.raises(DataError, match="sparse.ply is no PLY file"):
        load(folder)
    assert len(load(folder, points="random").points) == 100_000


def test_tartanair(world: World, tmp_path: Path):
    folder, lines = tmp_path / "House-easy-P000", []
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True)
    for i, image in enumerate(world.images):
        Image.fromarray(image).save(folder / "images" / f"{i + 10:06d}.jpg", quality=97, subsampling=0)
        least = -torch.nn.functional.max_pool2d(-truth(world, i)[None], 4)[0]
        steps = (8 * least).round().numpy().astype(np.uint16)
        steps[0] = 0
        Image.fromarray(steps).save(folder / "depth" / f"{i + 10:06d}.png")
        body = world.rotations[i].T @ LEFT_AHEAD.T
        numbers = [*world.centers[i], *Rotation.from_matrix(body).as_quat()]
        lines.append(" ".join([str(i + 10), *(repr(float(number)) for number in numbers)]))
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")
    (folder / "scene.json").write_text("{}")
    scene = load(folder)
    assert scene.notes[0].startswith("format: tartanair, ") and [view.name for view in scene.test] == ["000010"]
    for view in (*scene.test, *scene.train):
        i = int(view.name) - 10
        torch.testing.assert_close(view.cam_from_world[:3, :3], torch.from_numpy(world.rotations[i]), atol=1e-9, rtol=0)
        torch.testing.assert_close(view.center, torch.from_numpy(world.centers[i]), atol=1e-9, rtol=0)
        depth = view.load_depth()
        assert not depth[:4].any() and depth.shape == (32, 64)
        assert ((depth - truth(world, i))[4:] <= 1 / 16 + 1e-6).all()  # the least of 16 pixels, rounded
    (folder / "poses.txt").write_text("10 0 0 0 0 0 1\n")
    with pytest.raises(DataError, match="line 1 of .*poses.txt has 6 numbers after the frame; it must have 7"):
        load(folder)


@pytest.mark.parametrize(
    ("image", "depth"),
    [
        ("a.png", "a.png"),
        ("a.png", "depth_a"),
        ("a.png", "A"),
        ("caf\u00e9.png", "cafe\u0301"),
        ("up/a.png", "up/a_depth"),
    ],
)
def test_habits_of_names_of_depth_maps(image: str, depth: str, world: World, tmp_path: Path):
    path, file = tmp_path / "images" / image, tmp_path / "depths" / f"{depth}.npy"
    file.parent.mkdir(parents=True)
    np.save(file, truth(world, 0).numpy())
    (tmp_path / "depths" / "depth.json").write_text('{"measure": "ray"}')
    capture = Capture("made", tmp_path, tmp_path / "images", (Frame(image, path, torch.eye(4).double(), 64, 32),), None)
    assert _depth_files(capture)[0] == {image: file}
    other = replace(capture, frames=(replace(capture.frames[0], name="b.png"),))
    files, meaning, (note,) = _depth_files(other)
    assert (files, meaning) == ({}, None) and f"none of the 1 maps in {tmp_path / 'depths'} is named like an" in note


@pytest.mark.parametrize("unit", [1.0, 0.001])
def test_a_folder_of_depths_states_what_it_holds(unit: float, world: World, tmp_path: Path):
    write_colmap_text(world, tmp_path)
    before = load(tmp_path).fingerprint
    (tmp_path / "depths").mkdir()
    for i, name in enumerate(world.names[:5]):  # one view has none
        values = (truth(world, i) / unit).numpy()
        if unit == 1:
            np.save(tmp_path / "depths" / f"{name}.npy", values[::2, ::2])
        else:
            Image.fromarray(values.round().astype(np.uint16)).save(tmp_path / "depths" / f"{name}.png")
    statement = {"measure": "ray", "unit": unit} if unit != 1 else {"measure": "ray"}
    (tmp_path / "depths" / "depth.json").write_text(json.dumps(statement))
    scene = load(tmp_path)
    views = {view.name: view for view in (*scene.train, *scene.test)}
    for i, name in enumerate(world.names[:5]):
        expected = truth(world, i).float()
        if unit == 1:  # nearest samples of half the size
            expected = expected[::2, ::2].repeat_interleave(2, 0).repeat_interleave(2, 1)
        torch.testing.assert_close(views[name].load_depth(), expected, atol=unit / 2 if unit != 1 else 0, rtol=1e-6)
    assert views[world.names[5]].load_depth is None and scene.fingerprint != before
    assert any(note.startswith("depth: 5 of 6 views") for note in scene.notes)
    off, small = load(tmp_path, depth="none"), load(tmp_path, cache_bytes=0)
    assert off.fingerprint == before and not any(view.load_depth for view in off.train)
    assert torch.equal(small.train[0].load_depth(), scene.train[0].load_depth())  # read on each access


@pytest.mark.parametrize(
    ("statement", "values", "message"),
    [
        ('{"measure": "z"}', np.ones((4, 8)), "holds z .* but pano_00.png is a panorama, which has no such axis"),
        ('{"measure": "metres"}', np.ones((4, 8)), "depth.json does not say .*'metres'.*; write .*ray"),
        ('{"measure": "ray", "unit": 0}', np.ones((4, 8)), "does not say what the depth maps hold .*unit 0"),
        ('["ray"]', np.ones((4, 8)), "does not say what the depth maps hold"),
        ('{"measure": "ray"}', np.ones((4, 4)), "is 4x4, and pano_00.png is 64x32; .* the shape of its image"),
        ('{"measure": "ray"}', np.zeros((4, 8)), "holds no distance above 0"),
        (
            '{"measure": "ray"}',
            np.ones((4, 8, 3)),
            r"is an array of float64 \[4, 8, 3\]; it must",
        ),
        ('{"measure": "ray"}', b"\x93NUMPY", "is cut short or damaged"),
        ('{"measure": "ray"}', b"PK\x03\x04 of an .npz", "is cut short or damaged"),
        (f'{{"measure": "ray", "unit": {10**400}}}', np.ones((4, 8)), "does not say what the depth maps hold"),
        ('{"measure": "ray"}', np.full((4, 8), 2500, np.uint16), "does not say what the depth maps hold .*'unit'"),
    ],
)
def test_unknown_or_damaged_depths_are_refused(statement, values, message, world: World, tmp_path: Path):
    write_colmap_text(world, tmp_path)
    (tmp_path / "depths").mkdir()
    file = tmp_path / "depths" / f"{world.names[0]}.npy"
    if isinstance(values, bytes):
        file.write_bytes(values)
    else:
        np.save(file, values)
    (tmp_path / "depths" / "depth.json").write_text(statement)
    with pytest.raises(DataError, match=message):
        load(tmp_path)


@pytest.mark.parametrize("name", ["depths", "depth"])
@pytest.mark.parametrize("content", [b"\x93NUMPY cut", None])
def test_a_folder_of_depths_without_a_statement_is_not_used(name: str, content, world: World, tmp_path: Path):
    write_colmap_text(world, tmp_path)
    (tmp_path / name).mkdir()
    file = tmp_path / name / f"{world.names[0]}.npy"
    file.write_bytes(content) if content else np.save(file, np.ones((4, 8)))
    scene = load(tmp_path)
    assert not any(view.load_depth for view in (*scene.train, *scene.test))
    assert any(f"/{name} is not used: no depth.json says what its maps hold; to use" in note for note in scene.notes)
    assert check(tmp_path).problems == []
    with pytest.raises(ValueError, match=r"train.depth_weight is not 0, but no training view has a depth map"):
        Targets(scene.train, "none", depth="measured")


def test_depth_maps_in_tiff_files_and_folders_that_are_not_used(world: World, tmp_path: Path):
    write_colmap_text(world, tmp_path)
    for folder in (tmp_path / "Depths", tmp_path / "lidar_depth"):
        folder.mkdir()
    np.savez(tmp_path / "Depths" / f"{world.names[0]}.npz", truth(world, 0))
    notes = load(tmp_path).notes
    assert any("Depths holds no .npy, .exr, .png, .tif, .tiff, such as" in note for note in notes)
    assert "depth: lidar_depth/ is not used; name it depths/" in notes
    Image.fromarray(truth(world, 0).numpy().astype(np.float32)).save(tmp_path / "Depths" / f"{world.names[0]}.tif")
    (tmp_path / "Depths" / "depth.json").write_text('{"measure": "ray", "unit": 2}')
    scene = load(tmp_path)
    view = next(view for view in (*scene.train, *scene.test) if view.name == world.names[0])
    torch.testing.assert_close(view.load_depth(), 2 * truth(world, 0).float())


def test_of_two_maps_of_a_view_numbers_count_and_not_a_picture(world: World, tmp_path: Path):
    write_colmap_text(world, tmp_path)
    (tmp_path / "depths").mkdir()
    (tmp_path / "depths" / "depth.json").write_text('{"measure": "ray", "unit": 1}')
    np.save(tmp_path / "depths" / f"{world.names[0]}.npy", truth(world, 0).numpy())
    Image.fromarray(np.full((32, 64), 200, np.uint8)).save(tmp_path / "depths" / f"{world.names[0]}.png")
    view = next(view for view in load(tmp_path).train if view.name == world.names[0])
    torch.testing.assert_close(view.load_depth(), truth(world, 0).float())


def test_depths_are_checked_against_the_points_and_converted(world: World, tmp_path: Path):
    write_colmap_text(world, tmp_path / "a")
    (tmp_path / "a" / "depths").mkdir()
    for i, name in enumerate(world.names):
        np.save(tmp_path / "a" / "depths" / f"{name}.npy", 1000 * truth(world, i).numpy())
    statement = tmp_path / "a" / "depths" / "depth.json"
    statement.write_text('{"measure": "ray", "unit": 0.001}')
    assert any("depth maps agree with 99% of the points" in note for note in check(tmp_path / "a").notes)
    convert(tmp_path / "a", tmp_path / "b", "nerfstudio")
    before, after = load(tmp_path / "a").train[0], load(tmp_path / "b").train[0]
    torch.testing.assert_close(after.load_depth(), before.load_depth())
    statement.write_text('{"measure": "ray"}')
    random = check(tmp_path / "a", options=DataOptions(points="random"))
    assert random.problems == [] and not any("depth maps agree" in note for note in random.notes)
    (problem,) = check(tmp_path / "a").problems
    assert "agree with 0% of the points to 10%, and are about 1e+03 times as far" in problem


def test_an_image_of_depth_is_no_depth_map(world: World, tmp_path: Path):
    write_colmap_text(world, tmp_path)
    (tmp_path / "depths").mkdir()
    Image.new("L", world.size, 9).save(tmp_path / "depths" / f"{world.names[0]}.png")
    (tmp_path / "depths" / "depth.json").write_text('{"measure": "ray", "unit": 0.1}')
    with pytest.raises(DataError, match="has pixels of type L; a depth map needs 16 bits"):
        load(tmp_path)
    (tmp_path / "depths" / "depth.json").write_text('{"measure": "ray"}')
    with pytest.raises(DataError, match="does not say what the depth maps hold .*'unit'"):
        load(tmp_path)


def test_the_depth_of_an_exr_file_is_its_only_channel_or_z(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def holding(**levels: float) -> SimpleNamespace:
        channels = {name.replace("_", "."): SimpleNamespace(pixels=np.full((4, 8), x)) for name, x in levels.items()}
        file = SimpleNamespace(channels=lambda: channels)
        return SimpleNamespace(File=lambda *_, **__: file)

    for levels, depth in (({"V": 2.0}, 2), ({"R": 3, "G": 3, "B": 3, "A": 1}, 3), ({"R": 1, "G": 2, "View_Z": 4}, 4)):
        monkeypatch.setitem(sys.modules, "OpenEXR", holding(**levels))
        assert (_exr(tmp_path / "a.exr") == depth).all()
    monkeypatch.setitem(sys.modules, "OpenEXR", holding(R=1, G=2))
    with pytest.raises(DataError, match="a.exr holds the channels R, G, which differ"):
        _exr(tmp_path / "a.exr")


def test_z_of_a_perspective_view_becomes_the_distance_along_the_ray(tmp_path: Path):
    view = View("a", torch.eye(4, dtype=torch.float64), 8, 4, lens=Pinhole(8, 4, 3.0, 3.0, 4.0, 2.0))
    wall = Depth(tmp_path, DepthMeaning("z", 0.5, "test"), view, np.full((2, 4), 4, np.float32))()
    torch.testing.assert_close(wall * view.camera.rays()[..., 2], torch.full((4, 8), 2.0))


@pytest.mark.parametrize("measure", ["relative", "disparity"])
def test_depth_of_one_image_is_relative_and_not_scored(measure: str, world: World, tmp_path: Path):
    write_colmap_text(world, tmp_path)
    (tmp_path / "depths").mkdir()
    (tmp_path / "depths" / "depth.json").write_text(json.dumps({"measure": measure}))
    for i, name in enumerate(world.names):
        steps = (truth(world, i) if measure == "relative" else 1 / truth(world, i)).mul(9000).clamp(max=65535)
        Image.fromarray(steps.numpy().astype(np.uint16)).save(tmp_path / "depths" / f"{name}.png")
    scene = load(tmp_path)
    view = scene.test[0]
    ratio = view.load_depth() / truth(world, world.names.index(view.name))
    assert view.depth_is_relative and ratio.std() < 0.01 * ratio.mean()
    rendering = Rendering(view.image(), torch.zeros(32, 64), torch.ones(32, 64), torch.ones(1, dtype=torch.bool))
    protocols = {"sphere": replace(PROTOCOLS["sphere"], lpips="none")}
    assert "abs_rel" not in score(lambda _: rendering, scene, protocols, None)["sphere"].metrics
    with pytest.raises(ValueError, match="depth maps are relative; set train.depth_kind=monocular"):
        Targets(scene.train, "uniform", depth="measured")
    assert Targets(scene.train, "uniform", depth="monocular").at(0)[1].depth is not None


def test_depth_is_scored_where_it_is_known(world: World, tmp_path: Path):
    write_colmap_text(world, tmp_path)
    (tmp_path / "depths").mkdir()
    (tmp_path / "depths" / "depth.json").write_text('{"measure": "ray"}')
    known = truth(world, 1).numpy()
    known[:16], known[20] = 0, np.inf  # unknown, and sky
    np.save(tmp_path / "depths" / f"{world.names[1]}.npy", known)  # of the first of two test views
    scene = load(tmp_path)

    def render(view) -> Rendering:
        depth = (1.1 * truth(world, world.names.index(view.name))).float()
        depth[:16] = 50
        depth[28:] *= 2
        return Rendering(view.image(), torch.zeros(32, 64), depth, torch.ones(1, dtype=torch.bool))

    protocols = {name: replace(PROTOCOLS[name], lpips="none") for name in ("paper", "sphere")}
    scores = score(render, scene, protocols, None)
    area = torch.cos((torch.arange(32) + 0.5 - 16) / 32 * torch.pi)
    area[:16] = area[20] = 0
    share = (area[28:].sum() / area.sum()).item()
    assert "abs_rel" not in scores["paper"].metrics
    assert scores["sphere"].metrics["abs_rel"] == pytest.approx(0.1 * (1 - share) + 1.2 * share, rel=1e-4)
    assert scores["sphere"].metrics["delta_1_25"] == pytest.approx(1 - share, rel=1e-4)
    assert scores["sphere"].views[world.names[4]]["abs_rel"] is None


def test_data_sets_of_nested_folders_are_named(tmp_path: Path):
    assert [len(DATASETS[name].scenes) for name in ("ob3d", "tartanair")] == [24, 100]
    for name, scene in (("ob3d", "bistro/Egocentric"), ("tartanair", "urban/HongKong-hard-P004")):
        with pytest.raises(
            DataError, match=f"{DATASETS[name].title} is missing. Get it from https.* put it into .*{name},"
        ):
            load(tmp_path / name / scene)
    (tmp_path / "ob3d").mkdir()
    with pytest.raises(DataError, match="the scene 'bistro_Egocentric' of OB3D is missing"):
        load(tmp_path / "ob3d" / "bistro" / "Egocentric")
    assert lookup({"a": "padgs.data.formats.published:read_ob3d"}, "a", "x")
