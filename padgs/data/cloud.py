"""Point clouds: PLY files through plyfile, and the cloud from which training starts."""

import math
import re
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from io import BytesIO
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from padgs.data.camera_paths import centers
from padgs.data.capture import FARTHEST, Capture, Cloud, DataError, first_of, refuse_special
from padgs.files import atomic_path, given_path
from padgs.geometry.harmonics import DC

CHANNELS = (("red", "green", "blue"), ("r", "g", "b"))  # names of colours, after one of the prefixes; any case
PREFIXES = ("", "diffuse_", "scalar_", "vertex_", "color_")
SH_CHANNELS = ("f_dc_0", "f_dc_1", "f_dc_2")  # of files of Gaussians: colour = 1/2 + DC f_dc
NO_FILE = ("auto", "random")  # values of `data.points` that name no file
MOST_POINTS = 1_000_000  # more are thinned out evenly, because training starts from each of them
RANDOM_POINTS = 100_000
RANDOM_RADII = (0.5, 50.0)  # nearest and farthest random point, in multiples of the camera radius
VISIBLE_STEP = 0.002  # of the median distance of points from their middle
GREY = 128  # of points without colours


def read_ply(path: Path) -> Cloud:
    """Read a point cloud from a PLY file: x, y, z, and colours if there are any (`color_bytes`, or `SH_CHANNELS`)."""
    vertex, names = read_vertices(path)
    stored = {name.lower(): name for name in sorted(names)}

    def columns(*wanted: str) -> NDArray[Any]:
        return np.stack([np.asarray(vertex[stored[name]]) for name in wanted], axis=1)

    if not {"x", "y", "z"} <= stored.keys():
        raise DataError(f"{path} has the properties {', '.join(sorted(names))}; a point cloud needs x, y and z")
    groups = [[prefix + name for name in group] for prefix in PREFIXES for group in (*CHANNELS, SH_CHANNELS)]
    channels = next((group for group in groups if set(group) <= stored.keys()), None)
    packed = next((name for name in ("rgb", "rgba") if name in stored), None)
    colors = None
    if channels and channels[0].endswith(SH_CHANNELS[0]):
        colors = color_bytes((0.5 + DC * columns(*channels)).clip(0, 1), str(path))
    elif channels:
        colors = color_bytes(columns(*channels), str(path))
    elif packed and (bits := columns(packed)).itemsize == 4:  # PCL: 0xAARRGGBB, stored as an integer or a float
        colors = color_bytes((bits.view(np.uint32) >> np.array([16, 8, 0], np.uint32)).astype(np.uint8), str(path))
    return Cloud(torch.from_numpy(columns("x", "y", "z").astype(np.float64)), colors)


def read_cloud(path: Path) -> tuple[Cloud, tuple[str, ...]]:
    """Read a point cloud by its extension: LAS, LAZ, E57, else PLY; and notes."""
    if path.suffix.lower() in (".las", ".laz", ".e57"):
        from padgs.data import scans

        return scans.read_e57_points(path) if path.suffix.lower() == ".e57" else scans.read_las(path)
    return read_ply(path), ()


def color_bytes(values: NDArray[Any], where: str) -> Tensor:
    """Scale colours [P, 3] to uint8 by the range of their type: 1 for floats, 255 or 65535 for whole numbers.

    Fields of 16 bits often hold colours of 8 bits, and floats those of integers. The range is therefore the smallest
    that holds the median value (without black). A few values outside the range are clamped; `where` names the file.
    """
    if not (finite := np.isfinite(values).all(1)).all():
        raise DataError(f"the colour of point {(~finite).nonzero()[0][0]} of {where} is not finite; repair the cloud")
    if values.dtype == np.int8:
        values = values.view(np.uint8)
    ranges = (1, 255, 65535)
    if values.dtype.kind in "iu":
        largest = int(np.iinfo(values.dtype).max)
        ranges = sorted({bound for bound in (255, 65535, largest) if bound <= largest})
    typical = np.median(values[values > 0]) if (values > 0).any() else 0
    scale = 255 / next((bound for bound in ranges if typical <= bound), ranges[-1])
    return torch.from_numpy(np.rint(values.astype(np.float64) * scale).clip(0, 255).astype(np.uint8))


def whole_if_possible(values: NDArray[np.float64]) -> NDArray[Any]:
    """Return numbers of a text file as integers if all are whole, because text states no type."""
    return values.astype(np.int64) if (values == np.rint(values)).all() and (abs(values) < 2**53).all() else values


def read_vertices(path: Path) -> tuple[Any, set[str]]:
    """Return the columns of a PLY file's vertices, and the names of those that are numbers; else a DataError."""
    from plyfile import PlyData, PlyListProperty, PlyParseError

    refuse_special(path)
    try:
        with path.open("rb") as file:
            head = file.read(100)
        if not head:
            raise DataError(f"{path} is empty (0 bytes); copy it again")
        if not head.removeprefix(b"\xef\xbb\xbf").startswith(b"ply"):
            way_out = "convert it to PLY, or give points as LAS, LAZ or E57, none of them compressed"
            raise DataError(f"{path} is no PLY file, which begins with 'ply'; {way_out}")
        is_text = b"format ascii" in head
        try:
            # Memory-mapped if binary: reading 500 000 Gaussians row by row takes minutes.
            data = PlyData.read(_plain_text(path) if is_text else str(path))
        except UnicodeDecodeError:
            with NamedTemporaryFile() as plain:  # a file, to be memory-mapped as well
                plain.write(_plain_text(path).getbuffer())
                plain.flush()
                data = PlyData.read(plain.name)
        vertex = data["vertex"]
    except DataError:
        raise
    except FileNotFoundError as error:
        remedy = "set data.points to a PLY, LAS, LAZ or E57 file, or to random"
        raise DataError(f"the point cloud {path} does not exist; {remedy}") from error
    except KeyError as error:
        raise DataError(f"{path} has no element 'vertex'; it must be a point cloud") from error
    except (PlyParseError, OSError, ValueError, MemoryError, OverflowError, EOFError) as error:
        why = error or type(error).__name__
        raise DataError(f"{path} is not a readable PLY file ({why}); write or download it again") from error
    return vertex, {prop.name for prop in vertex.properties if not isinstance(prop, PlyListProperty)}


def _plain_text(path: Path) -> BytesIO:
    """Return a PLY file as plyfile reads it: an ASCII header without a byte-order mark, and x, y, z as doubles, since
    text holds more digits of map coordinates than a float.
    """
    header, end, rest = path.read_bytes().removeprefix(b"\xef\xbb\xbf").partition(b"end_header")
    header = header.decode("ascii", "replace").encode("ascii", "replace")
    if b"format ascii" in header:
        header = re.sub(rb"property +float(?:32)? +([xyz])\b", rb"property double \1", header)
    return BytesIO(header + end + rest)


def write_ply(path: Path, cloud: Cloud) -> None:
    """Write a binary PLY file: x, y, z as doubles, which is lossless, and red, green, blue if there are colours."""
    from plyfile import PlyData, PlyElement

    columns, fields = [*cloud.points.T.numpy()], [(axis, "f8") for axis in "xyz"]
    if cloud.colors is not None:
        columns += [*cloud.colors.T.numpy()]
        fields += [(channel, "u1") for channel in CHANNELS[0]]
    vertex = np.rec.fromarrays(columns, dtype=fields)
    with atomic_path(path) as draft:
        PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(draft))


def joined(clouds: Sequence[Cloud]) -> tuple[Cloud, tuple[str, ...]]:
    """Return the points of several clouds as one, and notes; without those that lack colours if others have them."""
    # Orientations are recognised by colours, which black ones of scanners without a camera, or grey, would hide.
    coloured = [cloud for cloud in clouds if cloud.colors is not None and cloud.colors.any()]
    used = coloured or clouds
    points = torch.cat([torch.zeros(0, 3, dtype=torch.float64), *(cloud.points for cloud in used)])
    colors = [cloud.colors for cloud in coloured if cloud.colors is not None]
    rest = sum(len(cloud.points) for cloud in clouds) - len(points)
    notes = (f"points: {rest} of scans without colours are left out, as others have colours",) if rest else ()
    return Cloud(points, torch.cat(colors) if colors else None), notes


def initial_cloud(capture: Capture, source: str) -> tuple[Tensor, Tensor, tuple[str, ...]]:
    """Return the initial points [P, 3] float64, their colours [P, 3] uint8, and notes; a DataError for unusable points.

    `source` is `data.points`: random, else the points of the capture, or random ones if it has none.
    """
    notes: tuple[str, ...] = ()
    cloud, model = capture.cloud, f"the {capture.format} model in {capture.folder}"
    where = model if source in NO_FILE else str(given_path(source, capture.folder))  # read with the capture
    if source == "random" or cloud is None:
        cloud = random_cloud(torch.stack([frame.cam_from_world for frame in capture.frames]))
        why = "data.points=random" if source == "random" else f"{capture.format} holds none; set data.points to a file"
        notes = (f"points: {RANDOM_POINTS} random points around the cameras ({why})",)
    points, colors = cloud.points, cloud.colors
    if not len(points):
        why = "training starts from a point cloud"
        raise DataError(f"{where} holds no points; {why}: set data.points to a PLY file, or to random")
    if bad := (~(points.abs() <= FARTHEST).all(1)).sum().item():
        rule = f"not finite, or farther than {FARTHEST:g} from the origin"
        raise DataError(f"{bad} of {len(points)} points of {where} are {rule}; remove them from the cloud")
    notes = (*notes, *_rounded(points, where))
    if (step := -(-len(points) // MOST_POINTS)) > 1:
        points, colors = points[::step], None if colors is None else colors[::step]
        notes = (*notes, f"points: one in {step} of {where}, {len(points)} in all")
    if colors is None or not colors.any():  # black is what scanners without a camera write
        colors = torch.full((len(points), 3), GREY, dtype=torch.uint8)
        notes = (*notes, "points: the cloud has no colours; grey is used")
    return points.double(), colors, notes


def _rounded(points: Tensor, where: str) -> tuple[str, ...]:
    """Return a note if 32-bit floats have rounded the points [P, 3] to steps that show at the size of their cloud.

    Such are map coordinates in most PLY files: at 5 400 000 m a step is half a metre.
    """
    far, spread = points.abs().max().item(), (points - points.median(0).values).norm(dim=1).median().item()
    step = 2.0 ** (math.floor(math.log2(max(far, 1e-30))) - 23)
    if not 0 < VISIBLE_STEP * spread < step or not torch.equal(points, points.float().double()):
        return ()
    rule = f"32-bit floats, which round coordinates of {far:.7g} to steps of {step:.2g}"
    return (f"points: those of {where} are {rule}; export the cloud with 64-bit coordinates, or in a nearby frame",)


def random_cloud(cam_from_world: Tensor, count: int = RANDOM_POINTS) -> Cloud:
    """Draw random points around cameras [F, 4, 4], uniform in direction and log distance; always the same ones."""
    positions = centers(cam_from_world)
    middle = positions.mean(0)
    spread = (positions - middle).norm(dim=1).max().clamp(min=1e-9)
    source = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=source, dtype=torch.float64), dim=1)
    near, far = RANDOM_RADII
    radius = near * (far / near) ** torch.rand(count, 1, generator=source, dtype=torch.float64)
    return Cloud(middle + spread * radius * direction, None)


def first_ply(folder: Path, names: tuple[str, ...], source: str = "auto") -> Cloud | None:
    """Read the first of the named PLY files that a folder has; None if there is none. `source`: see `forgiving`."""
    files = (first_of((folder / name).parent, (Path(name).name,)) for name in names)
    with forgiving(source):
        return next((read_ply(file) for file in files if file), None)
    return None


def forgiving(source: str) -> AbstractContextManager[object]:
    """Return a context in which a damaged cloud does not matter if `source`, that is `data.points`, is another."""
    return nullcontext() if source == "auto" else suppress(DataError)
