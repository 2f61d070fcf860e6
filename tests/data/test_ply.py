import os
from pathlib import Path

import numpy as np
import pytest
import torch
from support.fixtures import World, write_cloud

from padgs.data.capture import Capture, Cloud, DataError
from padgs.data.cloud import MOST_POINTS, initial_cloud, read_ply, write_ply
from padgs.data.formats.json_file import read_json


def test_write_and_read_lose_nothing(tmp_path: Path, generator: torch.Generator) -> None:
    points = torch.randn(50, 3, generator=generator, dtype=torch.float64) * 1e6
    colors = torch.randint(0, 256, (50, 3), generator=generator).to(torch.uint8)
    path = tmp_path / "Wölkchen 1.ply"
    write_ply(path, Cloud(points, colors))
    found = read_ply(path)
    assert torch.equal(found.points, points)
    assert found.colors is not None and torch.equal(found.colors, colors)
    write_ply(path, Cloud(points, None))
    assert read_ply(path).colors is None


def test_ascii_and_float_colours(world: World, tmp_path: Path) -> None:
    write_cloud(world, tmp_path / "a.ply")
    found = read_ply(tmp_path / "a.ply")
    assert torch.equal(found.points, torch.from_numpy(world.points))
    assert found.colors is not None and torch.equal(found.colors, torch.from_numpy(world.colors))
    text = "ply\nformat ascii 1.0\nelement vertex 1\n"
    text += "".join(f"property float {name}\n" for name in ("x", "y", "z", "red", "green", "blue"))
    (tmp_path / "b.ply").write_text(text + "end_header\n1 2 3 0.0 0.5 1.0\n")
    assert read_ply(tmp_path / "b.ply").colors.tolist() == [[0, 128, 255]]  # type: ignore[union-attr]
    (tmp_path / "b.ply").write_text(text + "end_header\n1 2 3 0.0 nan 1.0\n")
    with pytest.raises(DataError, match="the colour of point 0 of .*b.ply is not finite; repair the cloud"):
        read_ply(tmp_path / "b.ply")


def test_invalid_files_are_refused(world: World, tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    with pytest.raises(DataError, match="a.ply does not exist"):
        read_ply(path)
    for data in (b"", b"\x00\x01\x02garbage" * 9, b"ply\nformat ascii 1.0\n", b"<html>"):
        path.write_bytes(data)
        rules = (
            "is empty",
            "is no PLY file, which begins with 'ply'; convert it",
            "is not a readable PLY file .*write",
        )
        with pytest.raises(DataError, match=rf"^\S+a.ply ({'|'.join(rules)})"):
            read_ply(path)
    write_ply(path, Cloud(torch.from_numpy(world.points), None))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError, match="a.ply is not a readable PLY file"):
        read_ply(path)
    path.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n")
    with pytest.raises(DataError, match="a.ply has the properties x; a point cloud needs x, y and z"):
        read_ply(path)
    path.write_text("ply\nformat ascii 1.0\nelement face 1\nproperty float x\nend_header\n1\n")
    with pytest.raises(DataError, match="has no element 'vertex'"):
        read_ply(path)


def _write(path: Path, columns: dict[str, tuple[str, list[float]]], comment: bytes = b"") -> Path:
    """Write a binary PLY of one point per value, with x, y, z in front; columns are name -> (NumPy type, values)."""
    kinds = {"f4": "float", "f8": "double", "u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short", "i4": "int"}
    kinds["u4"] = "uint"
    count = len(next(iter(columns.values()))[1])
    columns = {axis: ("f4", [0.5] * count) for axis in "xyz"} | columns
    table = np.zeros(count, [(name, f"<{kind}") for name, (kind, _) in columns.items()])
    for name, (_, values) in columns.items():
        table[name] = values
    header = "".join(f"property {kinds[kind]} {name}\n" for name, (kind, _) in columns.items())
    start = b"ply\nformat binary_little_endian 1.0\n" + comment + f"element vertex {count}\n".encode()
    path.write_bytes(start + f"{header}end_header\n".encode() + table.tobytes())
    return path


EIGHT_BIT = [0, 1, 100, 200, 255]


@pytest.mark.parametrize(
    ("kind", "scale", "odd"),
    [
        ("u1", 1, None),
        ("i1", 1, None),
        ("u2", 257, None),
        ("u2", 1, 256),  # colours of 8 bits in a field of 16, and one value outside
        ("i2", 32767 / 255, None),
        ("i4", 1, 1000),
        ("i4", 257, None),
        ("u4", 16843009, None),
        ("f4", 1 / 255, 1.02),
        ("f4", 1 / 255, 40.0),
        ("f8", 1, 300.0),
        ("f4", 257, None),
    ],
)
def test_colours_are_scaled_by_the_range_of_their_type(kind: str, scale: float, odd: float | None, tmp_path: Path):
    values = np.array([value * scale for value in EIGHT_BIT])
    if kind == "i1":
        values = np.array(EIGHT_BIT, np.uint8).view(np.int8)
    stored = list(values if kind[0] == "f" else np.rint(values)) + ([] if odd is None else [odd])
    path = _write(tmp_path / "a.ply", {name: (kind, stored) for name in ("red", "green", "blue")})
    expected = EIGHT_BIT + ([] if odd is None else [255])
    assert read_ply(path).colors[:, 1].tolist() == expected  # type: ignore[index]


@pytest.mark.parametrize(
    "names",
    ["r g b", "Red Green Blue", "RED GREEN BLUE", "R G B", "diffuse_red diffuse_green diffuse_blue"]
    + ["scalar_Red scalar_Green scalar_Blue", "scalar_R scalar_G scalar_B"],
)
def test_names_of_colours(names: str, tmp_path: Path) -> None:
    columns = {name: ("f4", [value, 90.0]) for name, value in zip(names.split(), (10.0, 20.0, 30.0), strict=True)}
    found = read_ply(_write(tmp_path / "a.ply", columns, "comment Örtliche Koordinaten\n".encode()))
    assert found.colors.tolist() == [[10, 20, 30], [90, 90, 90]]  # type: ignore[union-attr]


def test_colours_of_gaussians_and_packed_colours(tmp_path: Path) -> None:
    for prefix in ("", "scalar_"):  # CloudCompare
        values = [[(value / 255 - 0.5) / 0.28209479, 9] for value in (10, 20, 30)]
        columns = {f"{prefix}f_dc_{i}": ("f4", column) for i, column in enumerate(values)}
        assert read_ply(_write(tmp_path / "a.ply", columns)).colors.tolist() == [[10, 20, 30], [255] * 3]  # type: ignore
    packed = np.array([0x0A141E, 0xFF5A5A5A], np.uint32)
    for name, values in (("rgb", packed.view(np.float32)), ("rgba", packed)):
        path = _write(tmp_path / "a.ply", {name: ("f4" if name == "rgb" else "u4", list(values))})
        assert read_ply(path).colors.tolist() == [[10, 20, 30], [90, 90, 90]]  # type: ignore[union-attr]


def test_black_points_are_without_colours(tmp_path: Path) -> None:
    for value, expected in ((0, 128), (7, 7)):
        cloud = read_ply(_write(tmp_path / "a.ply", {name: ("u1", [value]) for name in ("red", "green", "blue")}))
        _, colors, notes = initial_cloud(Capture("made", tmp_path, tmp_path, (), cloud), "auto")
        assert colors.unique().tolist() == [expected] and ("no colours; grey is used" in "".join(notes)) == (value == 0)


def test_axes_in_capitals_and_lists(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float X\nproperty float Y\nproperty float Z\n"
    (tmp_path / "a.ply").write_text(f"{header}property list uchar int extra\nend_header\n1 2 3 2 7 8\n")
    assert read_ply(tmp_path / "a.ply").points.tolist() == [[1, 2, 3]]
    header = header.replace("property float X", "property list uchar float x")
    (tmp_path / "a.ply").write_text(f"{header}end_header\n2 1 1 2 3\n")
    with pytest.raises(DataError, match="a.ply has the properties Y, Z; a point cloud needs x, y and z"):
        read_ply(tmp_path / "a.ply")


def test_pipes_and_folders_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.ply")
    for path in (tmp_path / "pipe.ply", tmp_path):
        with pytest.raises(DataError, match="it is no regular file"):
            read_ply(path)
        with pytest.raises(DataError, match="it is no regular file"):
            read_json(path)


def test_huge_counts_do_not_allocate_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 99999999999999\nproperty float x\nend_header\n"
    path.write_bytes(header.encode() + b"1234")
    with pytest.raises(DataError, match="not a readable PLY file"):
        read_ply(path)


def test_text_keeps_the_digits_of_map_coordinates(tmp_path: Path) -> None:
    header = (
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float32 y\nproperty float z\nend_header\n"
    )
    (tmp_path / "map.ply").write_text("\ufeff" + header + "691000.123 5399999.985 520.25\n0 1 2\n")
    assert read_ply(tmp_path / "map.ply").points.tolist() == [[691000.123, 5399999.985, 520.25], [0, 1, 2]]


@pytest.mark.parametrize(
    ("corner", "size", "kind", "noted"),
    [
        (5.4e6, 30, "f4", True),  # steps of 0.5
        (5.4e6, 30, "f8", False),
        (5.4e6, 3000, "f4", False),  # a town
        (30, 3, "f4", False),
        (1e-3, 1e-9, "f4", True),  # the same in another unit
        (0, 0, "f4", False),  # a single place
    ],
)
def test_rounded_points_are_noted(tmp_path: Path, corner: float, size: float, kind: str, noted: bool) -> None:
    places = corner + size * np.random.default_rng(0).random((50, 3))
    path = _write(tmp_path / "a.ply", {axis: (kind, list(places[:, k])) for k, axis in enumerate("xyz")})
    _, _, notes = initial_cloud(Capture("made", tmp_path, tmp_path, (), read_ply(path)), "a.ply")
    assert any("a.ply are 32-bit floats, which round" in note for note in notes) == noted


def test_points_beyond_what_can_be_rendered_are_refused(tmp_path: Path) -> None:
    for far in (1e16, float("nan"), float("inf"), -1e300):
        cloud = Cloud(torch.tensor([[0.0, 0, 1], [0, far, 0]], dtype=torch.float64), None)
        with pytest.raises(DataError, match=r"1 of 2 points .* are not finite, or farther than 1e\+15 from the origin"):
            initial_cloud(Capture("transforms", tmp_path, tmp_path, (), cloud), "auto")


def test_a_cloud_of_any_format_is_thinned_to_a_million_points(tmp_path: Path) -> None:
    points = torch.arange(3 * (2 * MOST_POINTS + 1), dtype=torch.float64).view(-1, 3)
    cloud = Cloud(points, (points % 200 + 1).to(torch.uint8))
    kept, colors, notes = initial_cloud(Capture("made", tmp_path, tmp_path, (), cloud), "auto")
    assert torch.equal(kept, points[::3]) and torch.equal(colors, cloud.colors[::3])
    assert any(note.startswith("points: one in 3 of the made model") for note in notes)
