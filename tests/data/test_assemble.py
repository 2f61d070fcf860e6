"""Assembly of scenes: sizes, names, points, notes and fingerprints."""

import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from support.fixtures import World, write_colmap_text
from torch import Tensor

from padgs.data import DATASETS, LOADERS, DataError, DataOptions, load, read
from padgs.data.assemble import _camera_notes, disk_cache
from padgs.data.capture import Capture, Cloud, Frame
from padgs.data.cloud import write_ply
from padgs.data.formats import poses
from padgs.data.images import ImageFile
from padgs.geometry.camera import Pinhole


@pytest.fixture
def folder(world: World, tmp_path: Path) -> Path:
    write_colmap_text(world, tmp_path / "scene")
    return tmp_path / "scene"


def test_reducing_keeps_poses_and_points(folder: Path) -> None:
    full, half = load(folder), load(folder, width=32)
    assert (half.train[0].width, half.train[0].height) == (32, 16)
    assert half.train[0].image().shape == (16, 32, 3)
    assert torch.equal(full.train[0].cam_from_world, half.train[0].cam_from_world)
    mean = full.train[0].image().unflatten(0, (16, 2)).unflatten(2, (32, 2)).mean((1, 3))
    assert (half.train[0].image() - mean).abs().max() <= 0.5 / 255 + 1e-6
    with pytest.raises(DataError, match=r"data.width=128 is wider than .*pano_00.png \(64\); images are only"):
        load(folder, width=128)


def test_the_fingerprint_depends_on_content_only(folder: Path) -> None:
    first = load(folder).fingerprint
    moved = folder.with_name("elsewhere")
    shutil.copytree(folder, moved)
    assert load(moved).fingerprint == first
    changed = {load(folder, width=32).fingerprint, load(folder, split="every", test_every=3).fingerprint}
    image = moved / "images" / "pano_02.png"
    pixels = np.array(Image.open(image))
    pixels[0, 0, 0] ^= 1
    Image.fromarray(pixels).save(image)
    changed.add(load(moved).fingerprint)
    points = folder / "sparse/0/points3D.txt"
    points.write_text(re.sub(r"\n7 \S+ ", "\n7 0.25 ", points.read_text()))
    changed.add(load(folder).fingerprint)
    assert len(changed - {first}) == 4


def test_georeferenced_captures_are_recentered(world: World, folder: Path, tmp_path: Path) -> None:
    utm = np.array([691_000.0, 5_334_000.0, 520.0])
    write_colmap_text(replace(world, centers=world.centers + utm, points=world.points + utm), tmp_path / "utm")
    near, far = load(folder), load(tmp_path / "utm")
    assert not near.origin.any() and far.notes[-1].startswith("world: origin moved to (")
    shift = (far.origin - torch.from_numpy(utm)).float()
    torch.testing.assert_close(far.points + shift, near.points, atol=1e-5, rtol=0)
    for one, other in zip(near.train, far.train, strict=True):
        torch.testing.assert_close(other.center + shift, one.center, atol=1e-6, rtol=0)


@pytest.mark.parametrize("size", [1, 500])
def test_points_of_another_world_than_the_cameras_are_refused(size: int, world: World, tmp_path: Path) -> None:
    """A room, and a campus of kilometres."""
    write_colmap_text(replace(world, centers=size * world.centers, points=size * world.points), tmp_path)
    cloud = Cloud(torch.from_numpy(size * world.points) + torch.tensor([5e5, 5.4e6, 0.0]), None)
    write_ply(tmp_path / "map.ply", cloud)
    with pytest.raises(DataError, match=r"so not in one world; export both .*Metashape: points in local coordinates"):
        load(tmp_path, points="map.ply")


def test_a_far_view_is_one_world(world: World, tmp_path: Path) -> None:
    far = world.points + 20 * np.abs(world.points).max() * np.array([1.0, 0.0, 0.0])
    write_colmap_text(replace(world, points=far), tmp_path)
    assert len(load(tmp_path).points) == len(far)


def test_images_and_points_may_be_named_from_the_working_directory(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (folder / "images").rename(tmp_path / "panos")
    write_ply(tmp_path / "lidar.ply", Cloud(torch.rand(50, 3, dtype=torch.float64), None))
    scene = load(folder, images="panos", points="lidar.ply")
    assert len(scene.points) == 50 and scene.train[0].image().shape[-1] == 3
    with pytest.raises(DataError, match="data.images=photos: there is no folder .*photos; name it from"):
        load(folder, images="photos")


def test_images_and_cameras_of_different_size(folder: Path) -> None:
    for path in (folder / "images").glob("*.png"):
        Image.open(path).resize((32, 16)).save(path)
    assert any("pano_00.png is 32x16, its camera 64x32; used as they are" in note for note in load(folder).notes)
    Image.new("RGB", (64, 32)).save(folder / "images" / "pano_03.png")  # of the same camera
    with pytest.raises(DataError, match="images and cameras disagree in size: .*pano_00.png .*pano_03.png"):
        load(folder)


def test_a_camera_of_a_photograph_without_pixels_is_refused() -> None:
    lens = Pinhole(60, 40, 50.0, 50.0, 30.0, 20.0)
    frame = Frame("a.jpg", Path("a.jpg"), torch.eye(4, dtype=torch.float64), width=0, height=0, lens=lambda *_: lens)
    with pytest.raises(DataError, match="the camera of a.jpg is 0x0; a camera has pixels: correct its size"):
        _camera_notes([frame], [ImageFile(Path("a.jpg"), 60, 40, "")])


def test_names_that_differ_in_case_only_and_second_poses_are_refused(folder: Path) -> None:
    lines = (folder / "sparse/0/images.txt").read_text()
    (folder / "sparse/0/images.txt").write_text(lines.replace("pano_03.png", "pano_02.png"))
    with pytest.raises(DataError, match="the image 'pano_02.png' has two poses; remove one"):
        load(folder)
    (folder / "sparse/0/images.txt").write_text(lines.replace("pano_03.png", "PANO_02.jpg"))
    with pytest.raises(DataError, match="'pano_02.png' and 'PANO_02.jpg' would share one name"):
        load(folder)


@pytest.mark.parametrize("pair", [("कमरा", "कमरी"), ("ที่", "ที"), ("שָ", "שִ")], ids=["Devanagari", "Thai", "Hebrew"])
def test_names_that_differ_in_vowel_signs_do_not_clash(pair: tuple[str, str], folder: Path) -> None:
    listing = folder / "sparse/0/images.txt"
    for old, new in zip(("pano_02", "pano_03"), pair, strict=True):
        (folder / "images" / f"{old}.png").rename(folder / "images" / f"{new}.png")
        for file in (listing, folder / "train.txt"):
            file.write_text(file.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
    assert {*pair} <= {view.name for view in load(folder).train}


def test_random_points_and_missing_files(folder: Path) -> None:
    scene = load(folder, points="random")
    spread = torch.stack([view.center for view in (*scene.train, *scene.test)])
    distance = (scene.points.double() - spread.mean(0)).norm(dim=1) / (spread - spread.mean(0)).norm(dim=1).max()
    assert 0.49 < distance.min() < 0.6 and 40 < distance.max() < 50.1
    assert torch.equal(scene.points, load(folder, points="random").points)
    with pytest.raises(DataError, match="the point cloud .*absent.ply does not exist"):
        load(folder, points="absent.ply")


def test_poses_without_an_image_do_not_matter_if_no_list_has_them(folder: Path) -> None:
    (folder / "images" / "pano_02.png").unlink()
    with pytest.raises(DataError, match="no image in .*: pano_02.png; .* or name the others in train.txt and test.txt"):
        load(folder)
    (folder / "train.txt").write_text("pano_00\npano_01\npano_03\n")
    (folder / "test.txt").write_text("pano_04\n")
    scene = load(folder)
    assert [view.name for view in scene.train] == ["pano_00", "pano_01", "pano_03"]
    assert "1 poses without an image are in neither list and are not used: pano_02.png" in scene.notes
    with pytest.raises(DataError, match="1 of 6 poses have no image"):
        load(folder, split="all")


def test_the_working_directory_has_a_name(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert load(".").name == load(folder).name == "scene"


@pytest.mark.parametrize(
    ("folder", "images", "places"),
    [
        ("flat", "flat/images/left", ("flat", "flat/images")),
        ("flat/export", "flat/images", ("flat/export", "flat")),
        ("flat", "flat", ("flat",)),
        ("flat/RGB", "flat/RGB", ("flat", "flat/RGB")),
    ],
)
def test_masks_depth_maps_and_lists_have_their_places(folder: str, images: str, places: tuple[str, ...]) -> None:
    found = Capture("made", Path("/scans", folder), Path("/scans", images), (), None).places
    assert found == tuple(Path("/scans", place) for place in places)


def test_missing_scenes_and_unknown_formats_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"absent does not exist; give the folder of"):
        load(tmp_path / "absent")
    (tmp_path / "photo.jpg").touch()
    with pytest.raises(DataError, match=r"no known format; it holds photo.jpg. Known: .*`padgs prepare IMAGES"):
        load(tmp_path)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "transforms.json").write_text("{}")
        hint = "a has: give that;" if name == "a" else "a, .*b have: give one;"
        with pytest.raises(DataError, match=f"no known format, but .*{hint} it holds"):
            load(tmp_path)
    (tmp_path / "transforms.json").write_text("{}")
    for i in range(60):
        (tmp_path / "a" / f"{i:02}.jpg").touch()
    (tmp_path / "a" / "transforms.json").rename(tmp_path / "a" / "more.json")
    (tmp_path / "a" / "scene").mkdir()
    (tmp_path / "a" / "scene" / "transforms.json").write_text("{}")
    with pytest.raises(DataError, match=f"{tmp_path}/a has no known format, but {tmp_path}/a/scene, {tmp_path} have:"):
        load(tmp_path / "a")
    with pytest.raises(ValueError, match="unknown data.format 'colmpa'; known: colmap"):
        load(tmp_path, "colmpa")


def test_files_and_folders_beside_a_data_set_lead_to_it(folder: Path, tmp_path: Path) -> None:
    for part in ("images", "sparse", "sparse/0/images.txt"):
        with pytest.raises(DataError, match=f"{part} has no known format, but {folder} has: give that"):
            load(folder / part)
    with pytest.raises(DataError, match="poses have no image .*; set data.images to ../../images, which holds pano"):
        load(folder / "sparse/0")
    assert load(folder / "sparse/0", images="../../images").fingerprint
    (tmp_path / "up" / "more").mkdir(parents=True)
    folder = folder.rename(tmp_path / "up/more/scene")
    with pytest.raises(DataError, match=f"up has no known format, but {folder} has: give that"):
        load(tmp_path / "up")


@pytest.mark.parametrize(
    ("name", "way"),
    [
        ("sfm_data.bin", "make sfm_data.json of it with openMVG_main_ConvertSfM_DataFormat"),
        ("scan.psx", "open it in Metashape, and export cameras.xml"),
        ("scan.zip", "unpack it"),
        ("transforms_360.json", "call it .* transforms.json"),
    ],
)
def test_files_in_another_form_are_named_with_a_way_out(name: str, way: str, tmp_path: Path) -> None:
    (tmp_path / name).touch()
    for path in (tmp_path, tmp_path / name):
        with pytest.raises(DataError, match=f"has no known format, but {name}: {way}"):
            load(path)


def test_several_files_of_metashape(tmp_path: Path) -> None:
    for name in ("a.xml", "b.xml"):
        (tmp_path / name).write_text("<document><chunk/></document>")
    with pytest.raises(DataError, match=r"no known format, but .*a.xml, .*b.xml have: give one"):
        load(tmp_path)


def test_missing_published_data_sets_name_their_source(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"360Roam is missing.*huajianup.* put it into .*360Roam, .*pose_c2w.json"):
        load(tmp_path / "360Roam" / "bar")
    (tmp_path / "Ricoh360").mkdir()
    with pytest.raises(DataError, match=r"'center' of Ricoh360 is missing. Get it from .*EgoNeRF"):
        load(tmp_path / "Ricoh360" / "center")
    with pytest.raises(DataError, match=r"'cat' is not a scene of Ricoh360; its scenes: bricks, .*cat_tower"):
        load(tmp_path / "cat", dataset="ricoh360")
    assert [len(DATASETS[name].scenes) for name in ("roam360", "ricoh360", "omniblender")] == [11, 12, 11]


def test_the_data_set_decides_the_mask(folder: Path) -> None:
    assert load(folder, dataset="roam360").train[0].mask() is not None
    assert load(folder, dataset="roam360", mask="none").train[0].mask() is None
    with pytest.raises(DataError, match="unknown data.dataset 'x'; known: roam360, ricoh360, omniblender"):
        load(folder, dataset="x")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("split", "half", "unknown data.split 'half'; known: auto, files, every, all"),
        ("test_every", 1, "data.test_every is 1"),
        ("width", 511, "data.width is 511; .*an even number"),
        ("cache_bytes", -1, "data.cache_bytes is -1; it must be 0"),
    ],
)
def test_unusable_options(field: str, value: object, message: str) -> None:
    with pytest.raises(DataError, match=message):
        DataOptions(**{field: value})  # type: ignore[arg-type]


def test_every_loader_can_be_imported() -> None:
    from padgs.checks import lookup

    for name in LOADERS:
        assert callable(lookup(LOADERS, name, "data.format"))


@pytest.mark.parametrize(("path", "format"), [(None, "auto"), (None, "synthetic"), ("nowhere", "synthetic")])
def test_generated_scenes_need_no_path(path: str | None, format: str) -> None:
    with pytest.raises(DataError, match=f"unknown synthetic scene '{path or 'cloud castle'}'"):
        load(path, format, generator={"scene": "cloud castle"})


def test_a_data_set_needs_a_path():
    with pytest.raises(DataError, match=r"data.path is not set; .* \+scene=roam360_bar"):
        load(dataset="roam360")


def test_images_that_the_disk_cache_holds_do_not_count_against_it(tmp_path, monkeypatch):
    free = 1000
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=free))
    options = DataOptions(cache_bytes=0, disk_cache=str(tmp_path / "cache"))
    assert disk_cache(options, 501)[0] is None and "half of the free space" in disk_cache(options, 501)[1][0]
    assert disk_cache(options, 400)[0] == tmp_path / "cache"
    (tmp_path / "cache" / "a").write_bytes(bytes(400))
    free = 600
    assert disk_cache(options, 400)[0] == tmp_path / "cache"


def test_a_disk_cache_that_cannot_be_made_is_done_without_unless_it_was_named(tmp_path, monkeypatch):
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path / "file" / "cache"))
    (tmp_path / "file").touch()
    folder, (note,) = disk_cache(DataOptions(cache_bytes=0), 400)
    assert folder is None and "cannot write" in note and "each is decoded when it is needed" in note
    with pytest.raises(DataError, match="data.disk_cache: cannot write .*; name another folder, or off"):
        disk_cache(DataOptions(cache_bytes=0, disk_cache=str(tmp_path / "file" / "other")), 400)


@pytest.mark.parametrize("place", [0.0, 5e6])
def test_fingerprints_do_not_depend_on_the_last_bits_of_poses(
    place: float, world: World, tmp_path, monkeypatch
) -> None:
    """Processors of other types compute other last bits, and a run goes on on another one of a cluster."""
    write_colmap_text(replace(world, centers=world.centers + place, points=world.points + place), tmp_path)
    before, exact = load(tmp_path), poses.checked_rotation
    noise = torch.Generator().manual_seed(0)

    def rounded_otherwise(rotation: Tensor, where: str) -> Tensor:
        return exact(rotation, where) + 2e-16 * torch.randn(3, 3, generator=noise, dtype=torch.float64)

    monkeypatch.setattr(poses, "checked_rotation", rounded_otherwise)
    after = load(tmp_path)
    assert after.fingerprint == before.fingerprint and torch.equal(after.points, before.points)
    assert not torch.equal(after.train[0].cam_from_world, before.train[0].cam_from_world)
    monkeypatch.setattr(poses, "checked_rotation", lambda rotation, where: exact(rotation, where) + 1e-5)
    assert load(tmp_path).fingerprint != before.fingerprint


def test_points_of_another_world_are_refused(world: World, tmp_path: Path) -> None:
    utm = np.array([691_000.0, 5_334_000.0, 520.0])
    for moved in ("points", "centers"):
        folder = tmp_path / moved
        write_colmap_text(replace(world, **{moved: getattr(world, moved) + utm}), folder)
        with pytest.raises(
            DataError, match=r"the cameras are around \(.*\), the points around \(.*one world; .*random"
        ):
            load(folder)
    assert load(folder, points="random").points.abs().max() < 1e5


def test_pointers_of_git_lfs_are_named(folder: Path) -> None:
    for name in ("images/pano_00.png", "sparse/0/cameras.txt"):
        kept = (folder / name).read_bytes()
        (folder / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
        with pytest.raises(
            DataError, match=rf"{Path(name).name} is a pointer of Git LFS, not the file; .*git lfs pull"
        ):
            load(folder)
        (folder / name).write_bytes(kept)


def test_two_cameras_may_be_reduced_to_one_size(folder: Path) -> None:
    """Theta S and Z1 in one model, all images resized."""
    cameras = folder / "sparse/0/cameras.txt"
    (line,) = [line for line in cameras.read_text().splitlines() if not line.startswith("#")]
    number, rest = line.split(maxsplit=1)
    cameras.write_text(f"{line}\n{int(number) + 1} {rest.replace('64', '128').replace('32', '64')}\n")
    images = folder / "sparse/0/images.txt"
    text = images.read_text()
    images.write_text(text.replace(f" {number} pano_01.png", f" {int(number) + 1} pano_01.png"))
    assert images.read_text() != text
    sizes = [(frame.width, frame.height) for frame in read(folder).frames]
    assert {*sizes} == {(64, 32), (128, 64)} and {view.width for view in load(folder).train} == {64}


@pytest.mark.parametrize("place", ["segmentation", "thumbs", "images/small"])
def test_images_of_the_same_names_in_other_folders_are_not_taken(place: str, folder: Path) -> None:
    (folder / place).mkdir(parents=True)
    for path in [*(folder / "images").glob("*.png")]:
        path.rename(folder / place / path.name)
    with pytest.raises(DataError, match="6 of 6 poses have no image .* has the name of one: set data.images"):
        load(folder)


def test_a_mask_is_not_proposed_for_a_missing_photograph(folder: Path) -> None:
    (folder / "masks").mkdir()
    (folder / "images/pano_02.png").rename(folder / "masks/pano_02.png")
    with pytest.raises(DataError, match="1 of 6 poses have no image .*: pano_02.png; set data.images to the folder"):
        load(folder)
