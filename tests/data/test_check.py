"""`padgs check` on sound, real and damaged data sets."""

import json
import re
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.fixtures import WRITERS, World, write_colmap_binary, write_colmap_text, write_transforms
from typer.testing import CliRunner

from padgs.cli.commands import app
from padgs.data import load
from padgs.data.capture import DataOptions
from padgs.data.check import check


@pytest.mark.parametrize("name", WRITERS)
def test_valid_data_sets_pass(name: str, world: World, tmp_path: Path) -> None:
    WRITERS[name](world, tmp_path / "scene")
    report = check(tmp_path / "scene", overlay=tmp_path / "look.png")
    assert report.problems == [] and report.suggestion is None
    assert (report.format, report.train, report.test, report.unused) == (name, 4, 2, 0)
    assert report.resolution == "64x32"
    if name not in ("openmvg", "omniblender"):  # no colours, no points
        assert report.colour_correlation is not None and report.colour_correlation > 0.9
    if name != "omniblender":
        assert report.exposure_spread is not None and report.exposure_spread < 0.05
    if name in ("colmap", "openmvg"):
        assert report.reprojection_95 is not None and report.reprojection_95 < 1e-9
    with Image.open(tmp_path / "look.png") as image:
        assert image.size == (64, 32)


@pytest.mark.parametrize(
    ("name", "up", "off_axis", "tilt", "reprojection"),
    [
        ("flat", "-y", 34.7, 0.3, 0.20),
        pytest.param("garden", "-y", 34.9, 2.1, 0.26, marks=pytest.mark.slow),
        ("room", "+z", 0.0, 0.0, None),
    ],
)
def test_real_data_sets_pass(
    name: str, up: str, off_axis: float, tilt: float, reprojection: float | None, shared: Path
) -> None:
    report = check(shared / "data" / name)
    assert report.problems == [] and report.suggestion is None and report.gravity is not None
    assert report.gravity.axis == up
    assert (report.gravity.off_axis, report.gravity.tilt) == pytest.approx((off_axis, tilt), abs=0.06)
    assert report.reprojection_median == (None if reprojection is None else pytest.approx(reprojection, abs=0.01))
    assert report.colour_correlation is not None and report.colour_correlation > 0.6


def _edit(folder: Path, file: str, change: Callable[[str], str]) -> None:
    path = folder / file
    path.write_text(change(path.read_text()))


def _save(folder: Path, name: str, pixels: np.ndarray) -> None:
    Image.fromarray(pixels).save(folder / name)


def _truncate(folder: Path) -> None:
    """Truncate an image, but keep the end marker."""
    path, whole = folder / "images/pano_02.png", BytesIO()
    Image.open(path).save(whole, "JPEG", quality=95)
    path.write_bytes(whole.getvalue()[: len(whole.getvalue()) // 2] + b"\xff\xd9")


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "image missing": (lambda f: (f / "images/pano_02.png").unlink(), "1 of 6 poses have no image in .*: pano_02.png"),
    "image damaged": (
        lambda f: (f / "images/pano_02.png").write_bytes(b"\x89PNG\r\n\x1a\n"),
        "pano_02.png is a PNG file of a kind that is not read, or is damaged",
    ),
    "image truncated": (_truncate, "pano_02.png is cut short, although it has an end marker"),
    "not 2:1": (lambda f: _save(f, "images/pano_03.png", np.zeros((32, 60, 3), np.uint8)), "60x32, which is not 2:1"),
    "mask hides all": (lambda f: _save(f, "mask.png", np.zeros((32, 64), np.uint8)), "mask.png hides every pixel"),
    "lists overlap": (lambda f: shutil.copy(f / "train.txt", f / "test.txt"), "train and test list overlap: pano_00"),
    "same image twice": (
        lambda f: shutil.copy(f / "images/pano_00.png", f / "images/pano_01.png"),
        "pano_01 is the same image as pano_00; remove one of them",
    ),
    "one picture with two training poses": (
        lambda f: shutil.copy(f / "images/pano_00.png", f / "images/pano_02.png"),
        "pano_02 is the same image as pano_00; remove one of them",
    ),
    "empty cloud": (lambda f: (f / "sparse/0/points3D.txt").write_text("\n"), "holds no points; training starts"),
    "binary garbage": (lambda f: (f / "sparse/0/images.bin").write_bytes(b"\x07" * 99), "images.bin ends early"),
    "masks inverted": (
        lambda f: _save(f, "mask.png", np.pad(np.full((3, 64), 255, np.uint8), ((29, 0), (0, 0)))),
        "the masks hide 98% of the sphere, in mask.png; .* white marks what to ignore .*, set data.mask=inverted; if ",
    ),
    "images of another place": (
        lambda f: _shuffle_colours(f),
        r"colours of points and panoramas correlate by only -?0.\d\d .* and under no other known convention better",
    ),
    "other axes": (lambda f: _rotate_points(f), "colours correlate by -?0.* and by 0.9. under another convention"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_damaged_data_sets_are_reported(case: str, world: World, tmp_path: Path) -> None:
    spoil, message = BROKEN[case]
    write_colmap_text(world, tmp_path)
    spoil(tmp_path)
    report = check(tmp_path)
    assert any(re.search(message, problem) for problem in report.problems), report.problems
    assert all("Traceback" not in problem for problem in report.problems)


def test_all_problems_are_reported_at_once(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path)
    for case in ("image damaged", "not 2:1", "lists overlap", "mask hides all"):
        BROKEN[case][0](tmp_path)
    problems = "\n".join(check(tmp_path).problems)
    assert (
        "pano_02.png is a PNG file of a kind that is not read, or is damaged" in problems
        and "pano_03.png is 60x32" in problems
    )
    for name in ("pano_02", "pano_03"):
        _save(tmp_path, f"images/{name}.png", world.images[2])
    problems = "\n".join(check(tmp_path).problems)
    assert "overlap" in problems and "hides every pixel" in problems
    (tmp_path / "depths").mkdir()
    np.save(tmp_path / "depths/pano_00.npy", np.ones((4, 8)))
    (tmp_path / "depths/depth.json").write_text("[]")
    problems = "\n".join(check(tmp_path).problems)
    assert "depth.json does not say what the depth maps hold" in problems and "overlap" in problems


@pytest.mark.parametrize(
    ("origin", "matrix", "suggestion"),
    [
        ((0, 0, 0), lambda pose: pose, "use (x, -y, -z) as (x, y, z), the convention of OpenGL"),
        ((1e5, -2e5, 3e4), lambda pose: np.linalg.inv(pose) @ np.diag([1, -1, -1, 1]), "invert them"),
    ],
)
def test_wrong_pose_conventions_are_recognised(origin, matrix, suggestion, world: World, tmp_path: Path) -> None:
    world = replace(world, centers=world.centers + origin, points=world.points + origin)
    write_transforms(world, tmp_path)
    meta = json.loads((tmp_path / "transforms.json").read_text())
    for i, frame in enumerate(meta["frames"]):
        frame["transform_matrix"] = matrix(world.world_from_cam(i)).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    report = check(tmp_path)
    assert report.suggestion is not None and suggestion in report.suggestion
    assert report.colour_correlation is not None and report.colour_correlation < 0.5


def test_the_command(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "ma scène"
    write_colmap_text(world, folder)
    run = CliRunner().invoke
    good = run(app, ["check", str(folder), "--overlay", str(tmp_path / "look.png")])
    assert good.exit_code == 0 and "ready for training" in good.output and "4 train, 2 test" in good.output
    assert (tmp_path / "look.png").is_file()
    monkeypatch.chdir(tmp_path)
    assert run(app, ["check", str(folder)]).exit_code == 0
    assert (folder / "check.png").is_file() and not (tmp_path / "check.png").exists()
    chosen = run(app, ["check", str(folder), "--points", "random", "--overlay", "none"])
    assert "100000 random points around the cameras (--points random)" in chosen.output
    (folder / "images/pano_02.png").unlink()
    bad = run(app, ["check", str(folder), "--overlay", "none"])
    assert (
        bad.exit_code == 1 and "PROBLEM" in bad.output and "pano_02.png" in bad.output and "1 problem(s)" in bad.output
    )
    assert run(app, ["check", str(tmp_path / "absent"), "--overlay", "none"]).exit_code == 1
    assert "unknown --split 'x'" in run(app, ["check", str(folder), "--split", "x"]).stderr
    assert "unknown --cameras 'x'" in run(app, ["check", str(folder), "--cameras", "x"]).stderr


def test_images_that_are_left_out_are_no_problem(world: World, tmp_path: Path) -> None:
    write_transforms(world, tmp_path)
    meta = json.loads((tmp_path / "transforms.json").read_text())
    meta["frames"][2] |= {"camera_model": "PINHOLE", "fl_x": 50, "fl_y": 50, "cx": 32, "cy": 16, "w": 64, "h": 32}
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    (tmp_path / meta["frames"][2]["file_path"]).write_bytes(b"damaged")
    options = DataOptions(split="all", cameras="panoramas")
    report = check(tmp_path, options=options)
    assert report.problems == [] and (report.train, report.unused) == (5, 0)
    problems = check(tmp_path, options=replace(options, cameras="all")).problems
    assert any("pano_02.png is not an image" in problem for problem in problems)


def test_mount_points_are_refused_at_once_and_links_are_followed(world: World, tmp_path: Path, monkeypatch) -> None:
    write_colmap_text(world, tmp_path / "a")
    (tmp_path / "far").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "far")
    run = CliRunner().invoke
    assert run(app, ["convert", str(tmp_path / "a"), str(tmp_path / "link"), "--to", "colmap"]).exit_code == 0
    assert (tmp_path / "link").is_symlink() and len(load(tmp_path / "far").train) == 4
    monkeypatch.setattr("os.path.ismount", lambda path: Path(path).name == "out")
    for command in (
        ("convert", tmp_path / "a", tmp_path / "out", "--to", "colmap"),
        ("prepare", tmp_path / "a/images", tmp_path / "out"),
    ):
        refused = run(app, [*map(str, command)])
        assert refused.exit_code == 1 and "is a mount point, which nothing can replace; name a new" in refused.stderr


def test_the_convert_command(world: World, tmp_path: Path) -> None:
    write_colmap_text(world, tmp_path / "a")
    run = CliRunner().invoke
    good = run(app, ["convert", str(tmp_path / "a"), str(tmp_path / "b"), "--to", "transforms", "--width", "32"])
    assert good.exit_code == 0 and "4 train and 2 test views, 400 points, as transforms" in good.output
    assert load(tmp_path / "b").train[0].width == 32
    again = run(app, ["convert", str(tmp_path / "a"), str(tmp_path / "b"), "--to", "colmap"])
    assert again.exit_code == 1 and "nothing is overwritten" in again.stderr
    assert (
        "unknown format 'obj'" in run(app, ["convert", str(tmp_path / "a"), str(tmp_path / "c"), "--to", "obj"]).stderr
    )


def test_the_camera_path_has_the_natural_order_of_names(world: World, tmp_path: Path) -> None:
    write_colmap_text(replace(world, names=("1", "2", "10", "11", "12", "100"), test=("2",)), tmp_path)
    steps = np.linalg.norm(np.diff(world.centers, axis=0), axis=1)
    assert check(tmp_path).path_length == pytest.approx(steps.sum())


def test_cameras_at_one_centre_are_a_problem_wherever_it_is(world: World, tmp_path: Path) -> None:
    write_colmap_text(replace(world, centers=np.tile([0.7, -0.3, 0.9], (6, 1))), tmp_path / "one")
    same = "all cameras have the same centre; depth cannot be learned"
    assert same in check(tmp_path / "one").problems
    write_colmap_text(world, tmp_path / "two")
    for side, name in (("train", "pano_00"), ("test", "pano_01")):
        (tmp_path / "two" / f"{side}.txt").write_text(name)
    report = check(tmp_path / "two")
    assert report.problems == [] and (report.train, report.test) == (1, 1), "the other one stands elsewhere"


def test_a_part_of_a_panorama_needs_no_mask(narrow: Path) -> None:
    report = check(narrow)
    assert report.problems == [] and report.suggestion is None
    assert [*report.masked.values()] == pytest.approx(6 * [8 / 9])
    assert report.colour_correlation is not None and report.colour_correlation > 0.95
    mask = np.zeros((48, 96), np.uint8)
    mask[16:19, 32:64] = 255  # 3 of the 16 rows that the pictures show
    _save(narrow, "mask.png", mask)
    notes = check(narrow, options=DataOptions(mask="mask.png")).notes
    assert any("the masks of 6 views hide more than 75% of the sphere: pano_00 (82.1%)" in note for note in notes), (
        notes
    )


def _shuffle_colours(folder: Path) -> None:
    """Give the points the colours of other points."""
    file = folder / "sparse/0/points3D.txt"
    rows = [line.split() for line in file.read_text().splitlines() if not line.startswith("#")]
    order = np.random.default_rng(0).permutation(len(rows))
    file.write_text("".join(" ".join([*row[:4], *rows[k][4:]]) + "\n" for row, k in zip(rows, order, strict=True)))


def _rotate_points(folder: Path) -> None:
    """Rotate the points, but not the poses, to a z-up world."""

    def rotated(text: str) -> str:
        rows = [line.split() for line in text.splitlines() if not line.startswith("#")]
        return "\n".join(" ".join([row[0], row[1], row[3], repr(-float(row[2])), *row[4:]]) for row in rows) + "\n"

    _edit(folder, "sparse/0/points3D.txt", rotated)


def test_without_a_folder_to_write_to_there_is_no_overlay_and_no_problem(world: World, tmp_path: Path, monkeypatch):
    write_colmap_text(world, tmp_path / "data")
    monkeypatch.setattr("padgs.cli.check.os.access", lambda *_: False)
    done = CliRunner().invoke(app, ["check", str(tmp_path / "data")])
    assert done.exit_code == 0 and "overlay" not in done.output, done.output


def test_points_that_walls_hide_are_no_problem(world: World, tmp_path: Path) -> None:
    write_colmap_binary(world, tmp_path)
    file, random = tmp_path / "sparse/0/points3D.bin", np.random.default_rng(0)
    places, colors = random.normal(0, 2, (3600, 3)).tolist(), random.integers(0, 256, (3600, 3)).tolist()
    hidden = [
        struct.pack("<Q3d3BdQ", 1000 + k, *place, *color, 0.1, 0)  # observed by none of the views
        for k, (place, color) in enumerate(zip(places, colors, strict=True))
    ]
    file.write_bytes(struct.pack("<Q", len(world.points) + 3600) + file.read_bytes()[8:] + b"".join(hidden))
    report = check(tmp_path)
    assert report.problems == [] and report.suggestion is None
    assert report.colour_correlation is not None and report.colour_correlation > 0.9
