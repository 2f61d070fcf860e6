"""NavVis' `pano-poses.csv`: the pose of each panorama in the world, as `padgs.data.formats.poses.cam_from_panorama`."""

import csv
import math
from pathlib import Path

import torch

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, DataError, DataOptions, Frame, Reading, listed
from padgs.data.cloud import read_cloud
from padgs.data.formats.poses import cam_from_panorama, rigid
from padgs.data.splits import check_name, read_lines

COLUMNS = ("pano_pos_x", "pano_pos_y", "pano_pos_z", "pano_ori_w", "pano_ori_x", "pano_ori_y", "pano_ori_z")


def read(path: Path, options: DataOptions) -> Capture:
    """Read `pano-poses.csv`, in the folder of the panoramas or above it, and a PLY, LAS, LAZ or E57 cloud beside it.

    Raises:
        DataError: a column is missing, or a row is not valid; the message names the line.
    """
    file = path if path.is_file() else path / "pano-poses.csv"
    file = file if path.is_file() or file.exists() else path / "pano" / "pano-poses.csv"
    lines = [(number, line) for number, line in enumerate(read_lines(file), 1) if line.strip()]
    if not lines:
        raise DataError(f"{file} holds no header; it must begin with '# pano poses v1.0: ID; filename; timestamp; ...'")
    head = lines[0][1].rpartition(":")[2].lstrip("# ")
    mark = ";" if ";" in head else ","
    names = [name.strip() for name in head.split(mark)]
    if absent := [name for name in ("filename", *COLUMNS) if name not in names]:
        raise DataError(f"{file}, line {lines[0][0]} lacks the columns {listed(absent, 8)}; export the poses again")
    folder = path if path.is_dir() else file.parent.parent if file.parent.name == "pano" else file.parent
    images = image_folder(folder, options.images) if options.images else image_folder(file.parent, None)
    frames = []
    for number, line in lines[1:]:
        row = next(csv.reader([line], delimiter=mark))
        where = f"{file}, line {number}"
        try:
            fields = dict(zip(names, map(str.strip, row), strict=True))
            values = torch.tensor([float(fields[name]) for name in COLUMNS], dtype=torch.float64)
        except ValueError as error:
            raise DataError(f"{where}: {mark.join(row)[:60]!r} is not {'; '.join(names)} ({error})") from error
        name = check_name(fields["filename"], where)
        frames.append(Frame(name, images / name, cam_from_panorama(values[3:], values[:3], where)))
    clouds = [file for end in ("ply", "las", "laz", "e57") for file in sorted(folder.glob(f"*.{end}"))]
    cloud, notes = read_cloud(clouds[0]) if clouds and options.points == "auto" else (None, ())
    if len(clouds) > 1:
        notes += (f"points: {clouds[0].name}, not {listed(file.name for file in clouds[1:])}; data.points chooses",)
    return Capture("navvis", folder, images, tuple(frames), cloud, notes=notes, readings=turned())


def turned() -> tuple[Reading, ...]:
    """Return the readings in which the centre of an image is along x, y, -x or -y of its panorama.

    Some programs export images turned by quarters, which the colours of points reveal.
    """
    zero, same, readings = torch.zeros(3, dtype=torch.float64), torch.eye(4, dtype=torch.float64), []
    for quarter, along in enumerate(("x", "y", "-x", "-y")):
        cosine, sine = round(math.cos(quarter * math.pi / 2)), round(math.sin(quarter * math.pi / 2))
        turn = torch.tensor([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]], dtype=torch.float64)
        readings.append(Reading(f"centres of images along {along} of their poses", rigid(turn, zero), same))
    return tuple(readings)
