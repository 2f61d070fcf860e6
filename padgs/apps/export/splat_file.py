"""Files of explicit Gaussians: the PLY of 3DGS, written and read; .splat, read; others through splat-transform.

A PLY holds per Gaussian x y z, nx ny nz (0; required by SIBR, the viewer of 3DGS), f_dc_0..2, f_rest_0.. (all
coefficients of red, then green, then blue), opacity (logit), scale_0..2 (logarithms) and rot_0..3 (w, x, y, z), as
float32: the parameters of `Splats`. 3DGS and some other programs read harmonics of degree 3 only, so zeros fill up
lower degrees; reading leaves them out.
"""

import json
import math
import os
import re
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from padgs.data.capture import DataError, listed
from padgs.data.cloud import color_bytes, read_vertices
from padgs.files import atomic_path, check_place, draft_of
from padgs.geometry import harmonics
from padgs.methods.splats.smoothing_filter import widened
from padgs.methods.splats.splats import Splats

CONVERTER = "splat-transform"
CONVERTED = (".compressed.ply", ".sog", ".spz", ".glb", ".html")  # suffixes that the converter writes
BYTES = ".splat"  # a row of 32 bytes for each Gaussian, without harmonics (antimatter15)
READ = (".ply", ".compressed.ply", ".sog", ".spz", BYTES, ".ksplat")
_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 3), ("opacity", "u1"), ("quat", "u1", 4)])
RUINED = 0.05  # share of Gaussians that a format may move by more than their size
MAX_LOGIT = 30.0  # formats of 8 bits hold opacities of exactly 0 and 1, whose logits are infinite
_POSITION, _NORMAL, _COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("f_dc_0", "f_dc_1", "f_dc_2")
_LAST = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
_NEEDED = [name for name in (*_POSITION, *_COLOR, *_LAST) if name != "scale_2"]
_PAINT = ("red", "green", "blue")
# Properties that are read, or that change no picture: normals, and numbers of objects.
_USUAL = re.compile(r"n?[xyz]|(f_dc|f_rest|scale|rot)_\d+|opacity|filter_3D|red|green|blue|.*(label|class|segment|id)")
_FLAT = math.log(torch.finfo(torch.float32).tiny)  # of a scale of 0, whose logarithm is infinite
_DISC = -9.0  # logarithm of the thickness of discs of 2DGS, which have no scale_2, relative to their smaller radius


def write_splats(path: Path, splats: Splats, comments: Sequence[str] = (), *, start: Tensor | None = None) -> str:
    """Write Gaussians to a .ply or a format of `CONVERTED`, chosen by the suffix; only active harmonics are written.

    `comments` are of a PLY header, `start` [2, 3] is the initial position and target of the viewer in an .html. Returns
    what the format's numbers are too coarse for, if anything; where they do not hold the scene, it is a ValueError.
    """
    check_suffix(path)
    if not path.name.lower().endswith(CONVERTED):
        _write_ply(path, splats, comments, degree=3)
        return ""
    suffix = path.suffix.lower()
    with draft_of(path.with_name(f"{path.name}-parts")) as folder:  # as large as the model
        folder.mkdir()
        plain = folder / "splats.ply"
        _write_ply(plain, splats, comments, splats.active_degree)
        settings = ["--spz-version", "3"] if suffix == ".spz" else []  # many viewers cannot read the default, 4
        if start is not None and suffix == ".html":
            # The world of SuperSplat's viewer is the file's rotated by 180 degrees about z.
            position, target = (start.double() * torch.tensor([-1.0, -1.0, 1.0])).tolist()
            camera = {"position": position, "target": target, "fov": 75, "startAnim": "none"}
            viewer = {"camera": camera, "background": {"color": [0, 0, 0]}, "animTracks": []}
            (folder / "viewer.json").write_text(json.dumps(viewer))
            settings = ["--viewer-settings", str(folder / "viewer.json")]
        made = folder / f"made{path.name}"
        try:
            _convert(plain, made, *settings)
            written = None if suffix in (".glb", ".html") else read_splats(made, scratch=folder)
        except ValueError as error:
            raise ValueError(f"{path} cannot be written ({error}); name another place, or write a .ply") from error
        lost = "" if written is None else _lost(splats, written, path)
        check_place(path)
        os.replace(made, path)
    return lost


def _lost(splats: Splats, written: Splats, path: Path) -> str:
    """Return how many Gaussians a format of few bits moved by more than their size; a ValueError if it ruins them."""
    from scipy.spatial import KDTree

    means, size = splats.means.detach().cpu().double(), splats.log_scales.detach().exp().amax(1).cpu().double()
    distance = torch.from_numpy(KDTree(written.means.detach().double().numpy()).query(means.numpy())[0])
    moved = distance > size
    if not moved.any():
        return ""
    text = f"{int(moved.sum())} of {len(splats)} Gaussians by more than their size, one by {distance.max():.3g} units"
    if moved.double().mean() > RUINED or (moved & (distance > splats.scene_scale)).any():
        sizes = f"Gaussians of {size.median():.2g} units reach {means.abs().max():.3g} units from the origin"
        raise ValueError(f"{path} would move {text}: its numbers do not suit a world in which {sizes}; write a .ply")
    return f"the format moved {text}"


def _convert(source: Path, target: Path, *more: str) -> None:
    # The converter leaves files of its own beside its target after an error: that must be in a folder that is removed.
    # One iteration over the palette of .sog and .html: 27 000 Gaussians take 26 s; ten take 226 s and gain 0.01 dB.
    options = ["--quiet", "--overwrite", "--gpu", "cpu", "-i", "1"]  # -i: named otherwise in version 3
    command = [CONVERTER, *options, *more, str(source.resolve()), str(target.resolve())]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode or not target.exists():
        said = [line.strip() for line in done.stdout.splitlines() if line.strip()] or ["without a word"]
        reason = next((line for line in said if "error" in line.lower() and not line.startswith("at ")), said[0])
        raise ValueError(f"{CONVERTER} failed: {reason[:300]}")


def check_suffix(path: Path) -> None:
    """Raise a ValueError early for an unknown suffix, or if the converter that it needs is not installed."""
    if not path.name.lower().endswith((".ply", *CONVERTED)):
        raise ValueError(f"{path} has an unknown format; known: .ply, {', '.join(CONVERTED)}")
    if path.name.lower() in (".ply", *CONVERTED):
        raise ValueError(f"{path} has no name before its suffix; name the file, such as {path.with_name('room.ply')}")
    if path.name.lower().endswith(CONVERTED):
        refuse_missing_converter(path, "writing")


def refuse_missing_converter(path: Path, doing: str) -> None:
    """Raise a ValueError if the converter is not installed; `doing` is what needs it."""
    if shutil.which(CONVERTER) is None:
        raise ValueError(
            f"{doing} {path.name} needs {CONVERTER}, which is not installed: npm install -g @playcanvas/{CONVERTER}; "
            "or take an ordinary .ply, which most programs read and write"
        )


def read_splats(path: Path, *, unit: float = 1.0, scratch: Path | None = None) -> Splats:
    """Read Gaussians from a file; `unit` is the scene scale, which files do not contain.

    Formats other than .ply and .splat, and compressed PLYs, are made a PLY first, in a folder in `scratch`, by default
    in that of the system. Means are float64 if the file's are, for map coordinates. Scales include the 3D filter of
    Mip-Splatting files. A DataError says that a file holds no Gaussians, a ValueError that the converter is not
    installed; properties that are not read are a warning.
    """
    if not path.exists():
        raise DataError(f"{path} does not exist; give a file of Gaussians, or the folder of a run")
    if path.name.lower().endswith(BYTES):
        return _read_bytes(path, unit)
    # Also a compressed PLY, whose name need not say so: the converter would fill up what a truncated one lacks.
    vertex, names = read_vertices(path) if path.suffix.lower() == ".ply" else ({}, {"packed_position"})
    if "packed_position" in names:
        refuse_missing_converter(path, "reading")
        with tempfile.TemporaryDirectory(dir=scratch) as folder:
            plain = Path(folder) / "splats.ply"
            try:
                _convert(path, plain)
            except ValueError as error:
                raise DataError(f"{path} cannot be read ({error}); export it again") from error
            return read_splats(plain, unit=unit)
    rest = sum(name.startswith("f_rest_") for name in names)
    painted = _COLOR[0] not in names and {*_PAINT} <= {*names}  # by `ns-export --ply-color-mode rgb`
    needed = [name for name in _NEEDED if not (painted and name in _COLOR)]
    if missing := [name for name in (*needed, *(f"f_rest_{n}" for n in range(rest))) if name not in names]:
        rule = f"Gaussians of 3DGS have {', '.join(_NEEDED)}; a point cloud belongs in data.points"
        raise DataError(f"{path} has no property {missing[0]}; {rule}")
    degree = round((rest / 3 + 1) ** 0.5) - 1
    if rest != 3 * ((degree + 1) ** 2 - 1) or degree > 4:
        raise DataError(f"{path} has {rest} properties f_rest_*; degrees 0 to 4 have 0, 9, 24, 45 or 72: export one")
    if degree > 3:
        warnings.warn(f"{path} has harmonics of degree 4; those up to degree 3 are used", stacklevel=2)
    if unread := sorted(name for name in names if not _USUAL.fullmatch(name)):
        warnings.warn(f"{path} may look different here: nothing reads its properties {listed(unread)}", stacklevel=2)

    def columns(*wanted: str) -> torch.Tensor:  # [N, len(wanted)]
        with np.errstate(over="ignore"):  # infinite numbers are counted and left out by others
            return torch.from_numpy(np.stack([np.asarray(vertex[name], np.float32) for name in wanted], axis=1))

    count = len(vertex["x"])
    sh_rest = columns(*(f"f_rest_{n}" for n in range(rest))) if rest else torch.zeros(count, 0)
    sh_rest, degree = sh_rest.view(count, 3, rest // 3)[..., :15], min(degree, 3)
    while degree and not sh_rest[..., degree**2 - 1 :].any():  # zeros that fill up
        sh_rest, degree = sh_rest[..., : degree**2 - 1], degree - 1
    empty = torch.zeros(0, 3)
    splats = Splats(empty, empty, empty, degree=degree, scene_scale=unit)
    kind = np.result_type(np.float32, vertex["x"].dtype)
    means = torch.from_numpy(np.stack([vertex[axis] for axis in _POSITION], axis=1, dtype=kind))
    splats.means.data = splats.means.data.to(means)
    quats = columns("rot_0", "rot_1", "rot_2", "rot_3")
    quats[~quats.any(1), 0] = 1  # no rotation
    scales = columns(*(name for name in ("scale_0", "scale_1", "scale_2") if name in names)).clamp(min=_FLAT)
    if "scale_2" not in names:
        scales = torch.cat((scales, scales.amin(1, keepdim=True) + _DISC), dim=1)
    paint = color_bytes(np.stack([vertex[name] for name in _PAINT], axis=1), str(path)) if painted else None
    dc = columns(*_COLOR) if paint is None else harmonics.dc_from_colors(paint / 255)
    rows = {"means": means, "log_scales": scales, "quats": quats, "sh_dc": dc, "sh_rest": sh_rest.transpose(1, 2)}
    splats.load(rows | {"opacity_logits": columns("opacity")[:, 0].clamp(-MAX_LOGIT, MAX_LOGIT)})
    splats.active_degree = degree
    return widened(splats, columns("filter_3D")[:, 0].square()) if "filter_3D" in names else splats


def _read_bytes(path: Path, unit: float) -> Splats:
    content = path.read_bytes()
    if not content or len(content) % _ROW.itemsize:
        raise DataError(
            f"{path} has {len(content)} bytes, not {_ROW.itemsize} for each Gaussian; copy or export it again"
        )
    rows = np.frombuffer(content, _ROW)
    means, scales = (torch.from_numpy(rows[name].copy()) for name in ("mean", "scale"))
    colors, opacities, quats = (
        torch.from_numpy(rows[name].astype(np.float32)) for name in ("color", "opacity", "quat")
    )
    empty = torch.zeros(0, 3)
    splats = Splats(empty, empty, empty, degree=0, scene_scale=unit)
    quats = quats - 128
    quats[~quats.any(1), 0] = 1  # no rotation
    logits = torch.logit(opacities / 255).clamp(-MAX_LOGIT, MAX_LOGIT)
    shapes = {"means": means, "quats": quats, "log_scales": scales.log().clamp(min=_FLAT), "opacity_logits": logits}
    dc, none = harmonics.dc_from_colors(colors / 255), torch.zeros(len(rows), 0, 3)
    splats.load(shapes | {"sh_dc": dc, "sh_rest": none})
    return splats


def _write_ply(path: Path, splats: Splats, comments: Sequence[str], degree: int) -> None:
    from plyfile import PlyData, PlyElement

    in_use, written = ((one + 1) ** 2 - 1 for one in (splats.active_degree, degree))
    rest = torch.nn.functional.pad(splats.sh_rest[:, :in_use].transpose(1, 2), (0, written - in_use))
    rest = rest.flatten(1)  # red first
    normals = torch.zeros_like(splats.means)
    rows = (splats.means, normals, splats.sh_dc, rest, splats.opacity_logits[:, None], splats.log_scales, splats.quats)
    table = torch.cat(rows, dim=1).detach().float().cpu().contiguous().numpy()
    names = (*_POSITION, *_NORMAL, *_COLOR, *(f"f_rest_{number}" for number in range(rest.shape[1])), *_LAST)
    vertex = table.view([(name, "<f4") for name in names])[:, 0]
    # Comments follow the count, which SIBR reads from the third line. PLY headers are ASCII.
    lines = [line.encode("unicode_escape").decode() for line in comments]
    with atomic_path(path) as draft:
        PlyData([PlyElement.describe(vertex, "vertex", comments=lines)], byte_order="<").write(str(draft))
