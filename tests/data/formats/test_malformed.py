"""Malformed JSON files are read, or refused by a DataError that names the position."""

import json
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
from support.fixtures import WRITERS, World, make_world, write_colmap_text

from padgs.data import DataError, load, read

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


def changed(document: Any, at: tuple[Any, ...], value: Any) -> Any:
    if not at:
        return value
    document = inner = deepcopy(document)
    for key in at[:-1]:
        inner = inner[key]
    inner[at[-1]] = value
    return document


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


WRONG = [
    ("transforms", ("w",), 0, "the camera of pano_00.png is 0x8; a full panorama is 2:1"),
    ("transforms", ("w",), float("inf"), "w of .*transforms.json is inf; it must be a whole number"),
    ("transforms", ("frames", 0, "file_path"), "x" * 300 + ".png", "file names have at most 255 bytes"),
    ("transforms", ("frames", 0, "file_path"), "\udce9.png", "which is not Unicode; rename the file"),
    ("transforms", ("frames", 0, "transform_matrix", 0, 3), 1e300, r"contains 1e\+300; nothing farther"),
    ("omniblender", ("width",), [], "width of .*transform.json must be a whole number, not list"),
    ("openmvg", ("structure",), 3, "structure of .*sfm_data.json must be a list, not int"),
    ("openmvg", ("structure", 0, "value", "X", 0), float("nan"), "1 of 3 points .*not finite"),
    ("opensfm", (1, "points"), 3, "points of entry 1 of .* must be an object, not int"),
    ("opensfm", (1, "points", "0", "color"), [float("nan")] * 3, "colour of point 0 of .* is not finite"),
]


@pytest.mark.parametrize(("name", "at", "value", "message"), WRONG)
def test_errors_name_the_position(name: str, at, value, message: str, small: World, tmp_path: Path) -> None:
    WRITERS[name](small, tmp_path / "scene")
    file = tmp_path / "scene" / FILES[name]
    file.write_text(json.dumps(changed(json.loads(file.read_text()), at, value)))
    with pytest.raises(DataError, match=message):
        load(tmp_path / "scene", name)


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
        (slice(1, 5), ["0"] * 4, "the quaternion has the length 0; it must be 1"),
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
