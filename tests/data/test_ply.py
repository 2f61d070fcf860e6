from pathlib import Path

import pytest
import torch
from support.fixtures import World, write_cloud

from padgs.data.capture import Cloud, DataError
from padgs.data.cloud import read_ply, write_ply


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
        with pytest.raises(DataError, match="a.ply is not a readable PLY file .*export it again"):
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


def test_huge_counts_do_not_allocate_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 99999999999999\nproperty float x\nend_header\n"
    path.write_bytes(header.encode() + b"1234")
    with pytest.raises(DataError, match="not a readable PLY file"):
        read_ply(path)
