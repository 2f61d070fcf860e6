"""Malformed JSON files are read, or refused by a DataError that names the position."""

import json
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.fixtures import WRITERS, World, make_world, write_cloud, write_colmap_text

from padgs.data import DataError, load, read
from padgs.data.formats.json_file import Json

FILES = {
    "transforms": "transforms.json",
    "openmvg": "sfm_data.json",
    "opensfm": "reconstruction.json",
    "roam360": "pose_c2w.json",
    "omniblender": "transform.json",
    "released": "data_views.json",
}
OTHERS = (None, 0, [], {}, "\ud800", 10**400)


@pytest.fixture(scope="module")
def small() -> World:
    return make_world(width=16, points=3)


def places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield all positions in a document; only the last of lists and of objects with many fields."""
    yield at
    keys = list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []
    for key in keys if isinstance(value, dict) and len(value) <= 12 else keys[-1:]:
        yield from places(value[key], (*at, key))


GONE = object()


def changed(document: Any, at: tuple[Any, ...], value: Any) -> Any:
    """Return a copy with another value at a position: removed, or a function of what is there."""
    if not at:
        return value
    document = inner = deepcopy(document)
    for key in at[:-1]:
        inner = inner[key]
    inner[at[-1]] = value(inner[at[-1]]) if callable(value) else value
    if value is GONE:
        del inner[at[-1]]
    return document


def times(*factors: float) -> Callable[[list[list[float]]], list[list[float]]]:
    """Return a change that scales the axes of a pose."""
    return lambda pose: [[f * x for f, x in zip((*factors, 1), row, strict=True)] for row in pose]


@pytest.mark.parametrize("name", FILES)
def test_values_of_other_types_raise_data_errors(name: str, small: World, tmp_path: Path) -> None:
    WRITERS[name](small, tmp_path / "scene")
    file = tmp_path / "scene" / FILES[name]
    document = json.loads(file.read_text())
    refused = 0
    for number, at in enumerate(places(document)):
        for value in OTHERS[number % 3 :: 3]:  # two for each place
            file.write_text(json.dumps(changed(document, at, value)))
            try:
                capture = read(tmp_path / "scene", name)
                capture.tracks and capture.tracks()
            except DataError:
                refused += 1
    assert refused > 10


@pytest.mark.parametrize("name", FILES)
def test_a_field_that_is_there_twice_is_refused(name: str, small: World, tmp_path: Path) -> None:
    WRITERS[name](small, tmp_path / "scene")
    file = tmp_path / "scene" / FILES[name]
    text, document = file.read_text(), json.loads(file.read_text())
    document = document if isinstance(document, dict) else document[0]
    key = next(iter(document))
    again = f"{json.dumps(key)}: {json.dumps(document[key])}, "
    file.write_text(text.replace("{", "{" + again, 1))
    assert len(read(tmp_path / "scene", name).frames) == 6, "the same twice says nothing else"
    file.write_text(text.replace("{", f'{{"{key}": "another", ', 1))
    with pytest.raises(DataError, match=f"{file.name} has '{key}' twice, with different values; remove one"):
        read(tmp_path / "scene", name)


@pytest.mark.parametrize(("name", "file"), [("openmvg", "sfm_data.json"), ("released", "data_extrinsics.json")])
def test_two_poses_of_one_key_are_refused(name: str, file: str, small: World, tmp_path: Path) -> None:
    WRITERS[name](small, tmp_path / "scene")
    path = tmp_path / "scene" / file
    document = json.loads(path.read_text())
    first, second, *_ = document["extrinsics"]
    document["extrinsics"].append({"key": first["key"], "value": second["value"]})
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match=rf"extrinsics of .*{file} has {first['key']} twice, with different values"):
        read(tmp_path / "scene", name)


@pytest.mark.parametrize(("name", "file"), [("openmvg", "sfm_data.json"), ("released", "data_views.json")])
def test_two_views_of_one_key_are_refused(name: str, file: str, small: World, tmp_path: Path) -> None:
    WRITERS[name](small, tmp_path / "scene")
    path = tmp_path / "scene" / file
    document = json.loads(path.read_text())
    document["views"][1]["key"] = document["views"][0]["key"]
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match=rf"views of .*{file} has {document['views'][0]['key']} twice"):
        read(tmp_path / "scene", name)


POSE = ("frames", 3, "transform_matrix")
LIST = ("test_filenames", 1)
WRONG: list[tuple[str, tuple[Any, ...], Any, str]] = [
    ("transforms", ("camera_model",), "OPENCV_FISHEYE", "'OPENCV_FISHEYE'; only EQUIRECTANGULAR"),
    ("transforms", ("camera_model",), GONE, "camera_model None"),
    ("transforms", ("frames",), GONE, "lacks the field 'frames'; it has camera_model, w, h"),
    ("transforms", POSE, GONE, "pano_03.png .* lacks the field 'transform_matrix'"),
    ("transforms", ("frames", 3, "share"), 0, "share .* is 0; it must be a number above 0 and at most 1"),
    ("transforms", (*POSE, 0, 3), float("nan"), "pano_03.png .*contains nan"),
    ("transforms", (*POSE, 0, 3), 1e300, r"contains 1e\+300; nothing farther"),
    ("transforms", POSE, times(2, 2, 2), "pano_03.png .* a rotation times 2; scale belongs"),
    ("transforms", (*POSE, 0, 0), 3.0, "is not a rotation: R R"),
    ("transforms", POSE, times(-1, 1, 1), "pano_03.png .*left-handed .*negate the column"),
    ("transforms", POSE, lambda pose: [*map(list, zip(*pose, strict=True))], "the pose is transposed, its last row"),
    ("transforms", (*POSE, 3, 3), 2, "must be 0 0 0 1"),
    ("transforms", POSE, "identity", "not an array of numbers"),
    ("transforms", (*POSE, 1), [1.0], "not an array of numbers"),
    ("transforms", ("frames", 0, "file_path"), "../../secret.png", "names '../../secret.png'; names must be relative"),
    ("transforms", ("frames", 0, "file_path"), "x" * 300 + ".png", "file names have at most 255 bytes"),
    ("transforms", ("frames", 0, "file_path"), "\udce9.png", "which is not Unicode; rename the file"),
    ("transforms", ("ply_file_path",), "/etc/passwd", "names '/etc/passwd'; names must be relative"),
    ("transforms", ("ply_file_path",), "absent.ply", "the point cloud .*absent.ply does not exist"),
    ("transforms", LIST, "images/x.png", "the test list of the data set names images .*: 'x.png'"),
    ("transforms", LIST, "images/pano_00.png", "overlap: pano_00.png"),
    ("transforms", ("h",), 33, "the camera of pano_00.png is 16x33; a full panorama is 2:1"),
    ("transforms", ("w",), 0, "the camera of pano_00.png is 0x8; a full panorama is 2:1"),
    ("transforms", ("w",), float("inf"), "w of .*transforms.json is inf; it must be a whole number"),
    ("omniblender", ("width",), [], "width of .*transform.json must be a whole number, not list"),
    ("openmvg", ("structure",), 3, "structure of .*sfm_data.json must be a list, not 3"),
    ("openmvg", ("structure", 0, "value", "X", 0), float("nan"), "1 of 3 points .*not finite"),
    ("openmvg", ("intrinsics", 0, "value", "polymorphic_name"), "fisheye", "a 'fisheye' camera; only spherical"),
    ("opensfm", (1, "points"), 3, "points of entry 1 of .* must be an object, not 3"),
    ("opensfm", (1, "points", "0", "color"), [float("nan")] * 3, "colour of point 0 of .* is not finite"),
    ("opensfm", (1, "cameras", "v2 camera spherical", "projection_type"), "brown", "a 'brown' camera; only spherical"),
    ("roam360", ("train", 0, "rgb_file"), "pano_01.jpg", "pano_01.jpg is both a train and a test view"),
    ("released", ("views", 0, "value", "ptr_wrapper", "data", "filename"), "../else.png", "names '../else.png'; names"),
]


@pytest.mark.parametrize(("name", "at", "value", "message"), WRONG)
def test_errors_name_the_position(name: str, at, value, message: str, small: World, tmp_path: Path) -> None:
    WRITERS[name](small, tmp_path / "scene")
    file = tmp_path / "scene" / FILES[name]
    file.write_text(json.dumps(changed(json.loads(file.read_text()), at, value)))
    with pytest.raises(DataError, match=message):
        load(tmp_path / "scene", name)


@pytest.mark.parametrize("name", FILES)
def test_files_that_are_not_json(name: str, small: World, tmp_path: Path) -> None:
    WRITERS[name](small, tmp_path / "scene")
    file = tmp_path / "scene" / FILES[name]
    file.write_text(file.read_text()[:-40])
    with pytest.raises(DataError, match=rf"{file.name} is not valid JSON \(.* line \d+"):
        load(tmp_path / "scene")
    file.write_text("{}" if name != "opensfm" else "[]")
    with pytest.raises(DataError, match=rf"{file.name} (lacks the field|must hold)"):
        load(tmp_path / "scene")


CLOUDS = [
    ("colmap", "sparse/0/points3D.bin", "points3D.bin ends early"),
    ("colmap text", "sparse/0/points3D.txt", "points3D.txt, line 1: 'damaged' is not ID"),
    ("colmap text", "sparse/0/points3D.ply", "points3D.ply is no PLY file"),
    ("openmvg", "colorized.ply", "colorized.ply is no PLY file"),
    ("opensfm", "reconstruction.json", "points of entry 1 of .*reconstruction.json must be an object, not 'damaged'"),
    ("roam360", "scene.ply", "scene.ply is no PLY file"),
    ("ricoh360", "openMVG/scene.ply", "scene.ply is no PLY file"),
    ("ricoh360", "output_dir/colmap/points3D.txt", "points3D.txt, line 1: 'damaged' is not ID"),
    ("omniblender", "pcd.ply", "pcd.ply is no PLY file"),
    ("released", "pcd.ply", "pcd.ply is no PLY file"),
    ("transforms", "sparse_pc.ply", "sparse_pc.ply is no PLY file"),
]


@pytest.mark.parametrize(("name", "cloud", "message"), CLOUDS)
def test_damaged_points_matter_only_if_they_are_used(name, cloud, message, small: World, tmp_path: Path) -> None:
    (WRITERS | {"colmap text": write_colmap_text})[name](small, tmp_path)
    write_cloud(small, tmp_path / "mine.ply")
    text = "damaged"
    if name == "opensfm":
        text = json.dumps(changed(json.loads((tmp_path / cloud).read_text()), (1, "points"), text))
    if cloud.endswith("points3D.ply"):
        (tmp_path / "sparse/0/points3D.txt").unlink()
    (tmp_path / cloud).parent.mkdir(exist_ok=True)
    (tmp_path / cloud).write_text(text)
    with pytest.raises(DataError, match=message):
        load(tmp_path)
    assert len(load(tmp_path, points="random").points) == 100_000
    assert load(tmp_path, points="mine.ply").point_colors.tolist() == small.colors.tolist()


def test_files_that_are_named_in_another_case_or_unicode_form_are_found(small: World, tmp_path: Path) -> None:
    WRITERS["transforms"](small, tmp_path)
    file = tmp_path / "transforms.json"
    document = json.loads(file.read_text())
    (tmp_path / "sparse_pc.ply").rename(tmp_path / "Points.PLY")
    (tmp_path / "Masks" / "Ku\u0308che").mkdir(parents=True)
    for i, frame in enumerate(document["frames"]):
        frame["mask_path"] = f"masks/k\u00fcche/M{i}.png"
        mask = np.repeat(np.uint8([255, 0]), [16 * (i + 2), 16 * (6 - i)]).reshape(8, 16)
        Image.fromarray(mask).save(tmp_path / "Masks" / "Ku\u0308che" / f"m{i}.PNG")
    for name in ("points.ply", ".\\POINTS.ply"):
        file.write_text(json.dumps({**document, "ply_file_path": name}))
        scene = load(tmp_path, split="all")
        assert [view.mask().mean().item() for view in scene.train] == [(i + 2) / 8 for i in range(6)]
        assert scene.point_colors.tolist() == small.colors.tolist()
    (tmp_path / "Masks" / "Ku\u0308che" / "m3.PNG").unlink()
    with pytest.raises(DataError, match="the mask .*masks/küche/M3.png that transforms names does not exist"):
        load(tmp_path)


def test_many_names_of_missing_files_take_no_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    searched = []
    glob = Path.glob
    monkeypatch.setattr(Path, "glob", lambda folder, pattern: searched.append(folder) or glob(folder, pattern))
    (tmp_path / "Masks").mkdir()
    for i in range(100):
        assert Json(f"masks/{i}.png", "mask_path").path_in(tmp_path) == tmp_path / "masks" / f"{i}.png"
    assert searched == [tmp_path, tmp_path / "Masks"]


def test_openmvg_cannot_reach_other_folders(small: World, tmp_path: Path) -> None:
    """Check that only the last name of `root_path`, from another machine, is used."""
    WRITERS["openmvg"](small, tmp_path / "scene")
    (tmp_path / "scene" / "images").rename(tmp_path / "elsewhere")
    file = tmp_path / "scene" / "sfm_data.json"
    document = json.loads(file.read_text())
    for root in (str(tmp_path / "elsewhere"), "..", "../elsewhere", "a\\..", "/"):
        file.write_text(json.dumps({**document, "root_path": root}))
        with pytest.raises(DataError, match="poses have no image in .*scene: "):
            load(tmp_path / "scene")
    (tmp_path / "elsewhere").rename(tmp_path / "scene" / "elsewhere")
    file.write_text(json.dumps({**document, "root_path": "C:\\else\\elsewhere"}))
    assert len(load(tmp_path / "scene").train) == 4


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (slice(1, 5), ["0"] * 4, "the rotation is all zeros, so the image has no pose"),
        (slice(5, 6), ["1e308"], r"contains 1e\+308; nothing farther than 1e\+15 .* can be rendered"),
    ],
)
def test_invalid_colmap_poses_are_refused(column, value, message, small: World, tmp_path: Path) -> None:
    write_colmap_text(small, tmp_path)
    file = tmp_path / "sparse" / "0" / "images.txt"
    lines = [line.split(" ") if line.endswith("pano_00.png") else [line] for line in file.read_text().split("\n")]
    (pose,) = (line for line in lines if line[-1] == "pano_00.png")
    pose[column] = value
    file.write_text("\n".join(" ".join(line) for line in lines))
    with pytest.raises(DataError, match=f"pano_00.png .*{message}"):
        load(tmp_path)


def test_colmap_cameras_without_pixels_are_refused(small: World, tmp_path: Path) -> None:
    write_colmap_text(small, tmp_path)
    file = tmp_path / "sparse" / "0" / "cameras.txt"
    file.write_text(file.read_text().replace(" 16 8", " 0 0"))
    with pytest.raises(DataError, match="camera of pano_00.png is 0x0"):
        load(tmp_path)
