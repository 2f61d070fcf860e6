import json
import math
import shutil
import struct

import numpy as np
import pytest
import torch
from numpy.lib import recfunctions as rfn
from plyfile import PlyData, PlyElement
from support.splat_cases import random_splats
from support.tiny_scene import tiny_scene

from padgs.apps.export import splat_file
from padgs.apps.export.splat_file import read_splats, write_splats
from padgs.data.capture import Cloud, DataError
from padgs.data.cloud import read_vertices, write_ply


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_writing_and_reading_is_lossless(degree, tmp_path, generator):
    splats = random_splats(degree, generator)
    write_splats(tmp_path / "a.ply", splats, ["said of it"])
    found = read_splats(tmp_path / "a.ply", unit=splats.scene_scale)
    assert (found.degree, found.active_degree, found.scene_scale) == (degree, degree, splats.scene_scale)
    for name, row in splats.rows().items():
        assert torch.equal(found.rows()[name], row), name
    assert PlyData.read(str(tmp_path / "a.ply"))["vertex"].comments == ["said of it"]


def test_columns_of_3dgs(tmp_path, generator):
    splats = random_splats(2, generator)
    write_splats(tmp_path / "a.ply", splats)
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    assert vertex["f_rest_1"][5] == splats.sh_rest[5, 1, 0].item(), "all of red comes first"
    assert vertex["f_rest_15"][5] == splats.sh_rest[5, 0, 1].item()
    assert vertex["rot_0"][5] == splats.quats[5, 0].item(), "w"
    splats.active_degree = 1
    write_splats(tmp_path / "a.ply", splats)
    assert read_splats(tmp_path / "a.ply").degree == 1, "harmonics that wait are not written"


def test_colours_in_place_of_harmonics_are_read(tmp_path, generator):
    """Files of `ns-export gaussian-splat --ply-color-mode rgb`."""
    splats = random_splats(0, generator)
    write_splats(tmp_path / "a.ply", splats)
    table = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    colors = np.arange(3 * len(table), dtype=np.uint8).reshape(-1, 3)
    table = rfn.drop_fields(table, ["f_dc_0", "f_dc_1", "f_dc_2"])
    table = rfn.append_fields(table, ["red", "green", "blue"], list(colors.T), usemask=False)
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "b.ply"))
    drawn = read_splats(tmp_path / "b.ply").gaussians(tiny_scene().train[0]).colors
    torch.testing.assert_close(drawn, torch.from_numpy(colors) / 255)
    for kind, largest in ((np.float32, 1), (np.uint16, 65535)):
        scaled = [(largest * (channel / 255)).astype(kind) for channel in colors.T]
        other = rfn.drop_fields(table, ["red", "green", "blue"])
        other = rfn.append_fields(other, ["red", "green", "blue"], scaled, usemask=False)
        PlyData([PlyElement.describe(other, "vertex")]).write(str(tmp_path / "d.ply"))
        drawn = read_splats(tmp_path / "d.ply").gaussians(tiny_scene().train[0]).colors
        torch.testing.assert_close(drawn, torch.from_numpy(colors) / 255, atol=0.002, rtol=0)
    bare = rfn.drop_fields(table, ["opacity"])
    PlyData([PlyElement.describe(bare, "vertex")]).write(str(tmp_path / "c.ply"))
    with pytest.raises(DataError, match="has no property opacity"):
        read_splats(tmp_path / "c.ply")


def test_rows_of_bytes_are_read(tmp_path):
    """32 bytes: position and scale as float32, red, green, blue and opacity, and w x y z as 128 (q + 1)."""
    rows = [(1, 2, 3, 0.5, 0.25, 0, 255, 0, 51, 204, 128 + 64, 128, 0, 128), (*[0] * 3, *[1] * 3, *[0] * 4, *[128] * 4)]
    (tmp_path / "a.splat").write_bytes(b"".join(struct.pack("<6f8B", *row) for row in rows))
    found = read_splats(tmp_path / "a.splat", unit=2.0)
    assert (len(found), found.degree, found.scene_scale) == (2, 0, 2.0)
    assert found.means[0].tolist() == [1, 2, 3]
    assert found.log_scales[0, :2].exp().tolist() == [0.5, 0.25] and torch.isfinite(found.log_scales).all()
    drawn = found.gaussians(tiny_scene().train[0])
    torch.testing.assert_close(drawn.colors[0], torch.tensor([1.0, 0.0, 0.2]))
    assert drawn.opacities.tolist() == pytest.approx([0.8, 0.0], abs=1e-6)
    torch.testing.assert_close(
        torch.nn.functional.normalize(found.quats[0], dim=0), torch.tensor([1, 0, -2, 0]) / 5**0.5
    )
    assert found.quats[1].tolist() == [1, 0, 0, 0], "no rotation"
    (tmp_path / "a.splat").write_bytes(bytes(33))
    with pytest.raises(DataError, match=r"a.splat has 33 bytes, not 32 for each Gaussian; copy or export it again"):
        read_splats(tmp_path / "a.splat")


@pytest.mark.parametrize(("degree", "active"), [(0, 0), (2, 1), (3, 2), (3, 3)])
def test_harmonics_up_to_degree_3_are_filled_up_with_zeros(degree, active, tmp_path, generator):
    splats = random_splats(degree, generator)
    splats.active_degree = active
    write_splats(tmp_path / "a.ply", splats)
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    names = [name for name in vertex.data.dtype.names if name.startswith("f_rest_")]
    rest = torch.stack([torch.from_numpy(vertex[name].copy()) for name in names], 1).view(-1, 3, 15)  # red first
    in_use = (active + 1) ** 2 - 1
    assert names == [f"f_rest_{number}" for number in range(45)] and not rest[:, :, in_use:].any()
    assert torch.equal(rest[:, :, :in_use], splats.sh_rest[:, :in_use].mT)
    found, view = read_splats(tmp_path / "a.ply", unit=splats.scene_scale), tiny_scene().train[0]
    assert found.degree == found.active_degree == active, "they are no part of the model"
    torch.testing.assert_close(found.gaussians(view).colors, splats.gaussians(view).colors)


def add_columns(file, to, *names):
    """Copy a PLY with further properties of ones."""
    table = PlyData.read(str(file))["vertex"].data
    table = rfn.append_fields(table, names, [np.ones(len(table), np.float32)] * len(names), usemask=False)
    PlyData([PlyElement.describe(table, "vertex")]).write(str(to))


def test_of_degree_4_the_lower_degrees_are_kept(tmp_path, generator):
    write_splats(tmp_path / "a.ply", splats := random_splats(3, generator))
    add_columns(tmp_path / "a.ply", tmp_path / "b.ply", *(f"f_rest_{number}" for number in range(45, 72)))
    table = PlyData.read(str(tmp_path / "b.ply"))["vertex"].data.copy()
    for number, rest in enumerate(splats.sh_rest.detach().numpy().transpose(2, 1, 0).reshape(45, -1)):
        channel, coefficient = divmod(number, 15)
        table[f"f_rest_{24 * channel + coefficient}"] = rest
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "c.ply"))
    with pytest.warns(UserWarning, match="c.ply has harmonics of degree 4; those up to degree 3 are used"):
        found = read_splats(tmp_path / "c.ply")
    assert found.degree == 3 and torch.equal(found.sh_rest, splats.sh_rest)


def test_properties_that_nothing_reads_are_named(tmp_path, generator):
    write_splats(tmp_path / "a.ply", random_splats(0, generator))
    add_columns(tmp_path / "a.ply", tmp_path / "b.ply", "label", "segment_id", "red", "filter_3D")
    read_splats(tmp_path / "b.ply")
    add_columns(tmp_path / "b.ply", tmp_path / "c.ply", "shape", "beta")
    with pytest.warns(UserWarning, match="c.ply may look different here: nothing reads its properties beta, shape"):
        read_splats(tmp_path / "c.ply")


def test_doubles_hold_map_coordinates(tmp_path, generator):
    write_splats(tmp_path / "a.ply", random_splats(0, generator))
    table = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    assert read_splats(tmp_path / "a.ply").means.dtype == torch.float32
    table = table.astype([(name, "f8" if name in "xyz" else "f4") for name in table.dtype.names])
    table["y"] = 5_334_000.456
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "a.ply"))
    found = read_splats(tmp_path / "a.ply")
    assert found.means[0, 1].item() == 5_334_000.456 and found.log_scales.dtype == torch.float32


def test_the_header_suits_the_viewer_of_3dgs(tmp_path, generator):
    """It takes the number of Gaussians from the third line, and rows by position; PLY is ASCII."""
    splats = random_splats(0, generator)
    write_splats(tmp_path / "a.ply", splats, ["run flat é"])
    header = (tmp_path / "a.ply").read_bytes().partition(b"end_header")[0].decode("ascii").splitlines()
    assert header[2:4] == [f"element vertex {len(splats)}", r"comment run flat \xe9"]
    first = [line.split()[-1] for line in header[4:13]]
    assert first == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]


def test_a_stored_filter_widens_and_a_zero_quaternion_turns_nothing(tmp_path, generator):
    """Mip-Splatting keeps its 3D filter beside the scales: 0.4 and 0.3 make 0.5, and opacity falls by (0.4 / 0.5)^3."""
    splats = random_splats(0, generator)
    with torch.no_grad():
        splats.log_scales.fill_(math.log(0.4))
        splats.quats[2] = 0.0
    write_splats(tmp_path / "a.ply", splats)
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    found = rfn.append_fields(vertex, "filter_3D", np.full(len(splats), 0.3, np.float32), usemask=False)
    PlyData([PlyElement.describe(found, "vertex")], byte_order=">").write(str(tmp_path / "big_endian.ply"))
    found = read_splats(tmp_path / "big_endian.ply")
    torch.testing.assert_close(found.log_scales.exp(), torch.full((len(splats), 3), 0.5))
    opacities = torch.sigmoid(splats.opacity_logits) * 0.8**3
    torch.testing.assert_close(torch.sigmoid(found.opacity_logits), opacities)
    assert found.quats[2].tolist() == [1, 0, 0, 0]


def test_discs_of_2dgs_are_thin_gaussians(tmp_path, generator):
    write_splats(tmp_path / "a.ply", splats := random_splats(1, generator))
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    flat = rfn.drop_fields(vertex, "scale_2")
    PlyData([PlyElement.describe(flat, "vertex")]).write(str(tmp_path / "b.ply"))
    found = read_splats(tmp_path / "b.ply")
    torch.testing.assert_close(found.log_scales[:, :2], splats.log_scales[:, :2])
    assert (found.log_scales[:, 2] < splats.log_scales[:, :2].amin(1) - 8).all() and torch.equal(
        found.means, splats.means
    )


def test_a_binary_file_with_letters_of_any_alphabet_is_read_at_once(tmp_path, generator):
    write_splats(tmp_path / "a.ply", random_splats(1, generator), ["x"])
    (tmp_path / "b.ply").write_bytes((tmp_path / "a.ply").read_bytes().replace(b"comment x", "comment Müller".encode()))
    vertex, _ = read_vertices(tmp_path / "b.ply")
    assert isinstance(vertex.data, np.memmap), "row by row takes minutes"
    assert torch.equal(read_splats(tmp_path / "b.ply").sh_rest, read_splats(tmp_path / "a.ply").sh_rest)


def test_invalid_files_are_refused(tmp_path, generator):
    splats = random_splats(0, generator)
    with pytest.raises(ValueError, match=r"a.obj has an unknown format; known: .ply, .compressed.ply"):
        write_splats(tmp_path / "a.obj", splats)
    with pytest.raises(ValueError, match=r"\.ply has no name before its suffix; name the file, such as .*/room\.ply"):
        write_splats(tmp_path / ".ply", splats)
    write_ply(tmp_path / "cloud.ply", Cloud(torch.zeros(2, 3), None))
    with pytest.raises(DataError, match="has no property f_dc_0; Gaussians of 3DGS have x, y, z"):
        read_splats(tmp_path / "cloud.ply")
    write_splats(tmp_path / "a.ply", splats)
    text = (tmp_path / "a.ply").read_bytes().replace(b"float opacity", b"float f_rest_45")
    (tmp_path / "a.ply").write_bytes(text)
    with pytest.raises(DataError, match="no property opacity"):
        read_splats(tmp_path / "a.ply")


def test_harmonics_are_numbered_from_0(tmp_path, generator):
    write_splats(tmp_path / "a.ply", random_splats(1, generator))
    text = (tmp_path / "a.ply").read_bytes().replace(b"float f_rest_0\n", b"float f_rest_45\n")
    (tmp_path / "a.ply").write_bytes(text)
    with pytest.raises(DataError, match="a.ply has no property f_rest_0; Gaussians of 3DGS"):
        read_splats(tmp_path / "a.ply")


def test_a_truncated_compressed_file_is_refused_before_it_is_converted(tmp_path, generator):
    write_splats(tmp_path / "a.ply", random_splats(1, generator))
    (tmp_path / "a.compressed.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-9])
    with pytest.raises(DataError, match="a.compressed.ply is not a readable PLY file .*end-of-file"):
        read_splats(tmp_path / "a.compressed.ply")


def test_a_missing_converter_is_reported(tmp_path, generator, monkeypatch):
    monkeypatch.setattr(splat_file.shutil, "which", lambda name: None)
    with pytest.raises(ValueError, match="npm install -g @playcanvas/splat-transform; or take an ordinary .ply"):
        write_splats(tmp_path / "a.spz", random_splats(0, generator))


@pytest.mark.skipif(shutil.which(splat_file.CONVERTER) is None, reason="splat-transform is not installed")
def test_a_converted_file_holds_the_same_gaussians(tmp_path, generator):
    splats = random_splats(1, generator)
    write_splats(tmp_path / "a.spz", splats)
    splat_file.subprocess.run(
        [splat_file.CONVERTER, "-q", str(tmp_path / "a.spz"), str(tmp_path / "back.ply")], check=True
    )
    back = read_splats(tmp_path / "back.ply")
    nearest = torch.cdist(splats.means, back.means).min(dim=1)
    assert nearest.values.max() < 1e-3
    assert torch.allclose(back.log_scales[nearest.indices], splats.log_scales, atol=0.05)


@pytest.mark.parametrize(
    ("world", "moved", "said"),
    [
        (1.0, 0, ""),
        (1.0, 1, "the format moved 1 of 40 Gaussians by more than their size, one by "),
        (1.0, 9, "would move 9 of 40 Gaussians by more than their size"),
        (1e4, 0, "would move 4?[0-9] of 40 Gaussians .* reach .* units from the origin; write a .ply"),
        (1e-5, 0, "would move 4?[0-9] of 40 Gaussians"),
    ],
)
def test_gaussians_that_a_format_cannot_hold_are_counted_or_refused(
    world, moved, said, tmp_path, generator, monkeypatch
):
    """Positions as in .spz: 24 bits a coordinate, in steps of 1/4096 unit, so that they start again at 2048 units."""
    splats = random_splats(0, generator)
    splats.load({name: torch.cat([rows] * 40)[:40] for name, rows in splats.rows().items()})
    with torch.no_grad():
        splats.means.copy_(world * torch.randn(40, 3, generator=generator))
        splats.log_scales.fill_(math.log(0.1 * world))
    splats.scene_scale = 2.0 * world

    def convert(source, target, *_):
        vertex = PlyData.read(str(source))["vertex"].data.copy()
        if target.suffix == ".spz":
            for axis in "xyz":
                steps = np.round(vertex[axis].astype(float) * 4096).astype(np.int64)
                vertex[axis] = ((steps + 2**23) % 2**24 - 2**23) / 4096
            vertex["x"][:moved] += np.float32(0.5 * world)
        PlyData([PlyElement.describe(vertex, "vertex")]).write(str(target))

    monkeypatch.setattr(splat_file, "refuse_missing_converter", lambda *_: None)  # where the converter is missing
    monkeypatch.setattr(splat_file, "_convert", convert)
    path = tmp_path / "a.spz"
    if "would" in said:
        with pytest.raises(ValueError, match=said):
            write_splats(path, splats)
        assert not path.exists()
    else:
        assert write_splats(path, splats).startswith(said) and len(read_splats(path)) == 40
        assert (said == "") == (write_splats(path, splats) == "")


@pytest.fixture
def converter(tmp_path, monkeypatch):
    """Return a function that installs a shell script as the converter."""
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")

    def install(script: str) -> None:
        (tmp_path / splat_file.CONVERTER).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / splat_file.CONVERTER).chmod(0o755)

    return install


LAST_TWO = "while [ $# -gt 2 ]; do shift; done"  # source and target become the only arguments
COPY = f'{LAST_TWO}; cp "$1" "$2"'


def test_a_ply_is_compressed_by_its_content_not_by_its_name(tmp_path, generator, converter):
    write_splats(tmp_path / "a.ply", splats := random_splats(1, generator))
    shutil.copy(tmp_path / "a.ply", tmp_path / "plain.compressed.ply")
    assert torch.equal(read_splats(tmp_path / "plain.compressed.ply").means, splats.means), "without the converter"
    packed = np.zeros(4, [("packed_position", "<u4")])
    PlyData([PlyElement.describe(packed, "vertex")]).write(str(tmp_path / "b.ply"))
    with pytest.raises(ValueError, match=r"reading b.ply needs splat-transform, .* or take an ordinary .ply"):
        read_splats(tmp_path / "b.ply")
    converter(f'{LAST_TWO}; cp {tmp_path}/a.ply "$2"')
    assert torch.equal(read_splats(tmp_path / "b.ply").means, splats.means)


def test_spz_is_of_version_3_and_glb_is_not_read_back(tmp_path, generator, converter):
    """Many viewers read no version 4; only the option makes this one write."""
    converter(f'case "$*" in *.spz) echo "$*" | grep -q -e "--spz-version 3 " || exit 1;; esac; {COPY}')
    write_splats(tmp_path / "a.spz", splats := random_splats(2, generator))
    assert len(PlyData.read(str(tmp_path / "a.spz"))["vertex"].data.dtype.names) == 17 + 24, "of the model's degree"
    converter(f'{LAST_TWO}; case "$1" in *.glb) exit 1;; esac; {COPY}')
    write_splats(tmp_path / "a.glb", splats)
    assert (tmp_path / "a.glb").stat().st_size


def test_a_page_begins_where_a_photograph_was_taken(tmp_path, generator, converter):
    converter("while [ $# -gt 2 ]; do [ $1 = --viewer-settings ] && found=$2; shift; done; cp $found $2")
    begin = torch.tensor([[1.0, 2.0, 3.0], [1.0, 2.0, 4.0]])
    write_splats(tmp_path / "a.html", random_splats(0, generator), start=begin)
    camera = json.loads((tmp_path / "a.html").read_text())["camera"]
    assert (camera["position"], camera["target"]) == ([-1, -2, 3], [-1, -2, 4]), "its y is up, and its x is left"


def test_a_failing_converter_is_quoted_and_keeps_the_earlier_file(tmp_path, generator, converter):
    left = 'echo half >"$1"; echo half >"${1%/*}/..tmp"'
    converter(f"while [ $# -gt 1 ]; do shift; done; {left}; echo 'ERROR no room'; echo 'at f (cli.mjs:9:9)'; exit 3")
    (tmp_path / "a.spz").write_text("the earlier one")
    with pytest.raises(ValueError, match=r"a.spz cannot be written \(splat-transform failed: ERROR no room\); name"):
        write_splats(tmp_path / "a.spz", random_splats(0, generator))
    assert (tmp_path / "a.spz").read_text() == "the earlier one"
    with pytest.raises(DataError, match=r"a.spz cannot be read \(splat-transform failed: ERROR no room\); export"):
        read_splats(tmp_path / "a.spz")
    assert {path.name for path in tmp_path.iterdir()} == {"a.spz", splat_file.CONVERTER}
