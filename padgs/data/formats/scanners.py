"""Captures of scanners: panoramas with poses as `padgs.data.formats.poses.cam_from_panorama`, and a point cloud.

NavVis: `pano-poses.csv`, in the folder of the panoramas or above it, and a PLY, LAS, LAZ or E57 cloud beside it. E57
files hold panoramas, poses and points.
"""

import csv
import hashlib
import json
import math
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, Cloud, DataError, DataOptions, Frame, Reading, files_with, listed
from padgs.data.cloud import joined, read_cloud
from padgs.data.formats.json_file import file_in
from padgs.data.formats.poses import cam_from_panorama, rigid
from padgs.data.scans import open_e57
from padgs.data.splits import check_name, read_lines
from padgs.files import write_atomically

WRITTEN = ".padgs-written.json"  # digests by name of the pictures that padgs wrote
COLUMNS = ("pano_pos_x", "pano_pos_y", "pano_pos_z", "pano_ori_w", "pano_ori_x", "pano_ori_y", "pano_ori_z")


def read_navvis(path: Path, options: DataOptions) -> Capture:
    """Read `pano-poses.csv` and a cloud; a DataError names the line that lacks a column or is not valid."""
    file = file_in(path, "pano-poses.csv")
    file = file if file.exists() else file_in(path / "pano", "pano-poses.csv")
    lines = [(number, line) for number, line in enumerate(read_lines(file), 1) if line.strip()]
    if not lines:
        raise DataError(f"{file} holds no header; it must begin with '# pano poses v1.0: ID; filename; timestamp; ...'")
    first = next((n for n, (_, line) in enumerate(lines) if "filename" in line.casefold()), 0)
    head = lines[first][1].rpartition(":")[2].lstrip("# ")
    mark = next(sign for sign in ";\t," if sign in head or sign == ",")
    stated = [name.strip() for name in head.split(mark)]
    names = [name.casefold() for name in stated]
    if absent := [name for name in ("filename", *COLUMNS) if name not in names]:
        raise DataError(f"{file}, line {lines[first][0]} lacks the columns {listed(absent, 8)}; export the poses again")
    folder = file.absolute().parent
    folder = folder.parent if folder.name == "pano" else folder
    images = image_folder(folder, options.images) if options.images else image_folder(file.parent, None)
    frames = []
    for number, line in (row for row in lines[first + 1 :] if not row[1].startswith("#")):
        row = next(csv.reader([line], delimiter=mark, skipinitialspace=True))
        where = f"{file}, line {number}"
        try:
            fields = dict(zip(names, map(str.strip, row), strict=True))
            values = torch.tensor([float(fields[name]) for name in COLUMNS], dtype=torch.float64)
        except ValueError as error:
            what = f"{line.strip()[:60]!r} is not {'; '.join(stated)} ({error})"
            raise DataError(f"{where}: {what}; export the poses again, with decimal points") from error
        name = check_name(fields["filename"], where)
        frames.append(Frame(name, images / name, cam_from_panorama(values[3:], values[:3], where)))
    clouds = [file for suffix in (".ply", ".las", ".laz", ".e57") for file in files_with(folder, suffix)]
    cloud, notes = read_cloud(clouds[0]) if clouds and options.points == "auto" else (None, ())
    if len(clouds) > 1:
        notes += (f"points: {clouds[0].name}, not {listed(file.name for file in clouds[1:])}; data.points chooses",)
    return Capture("navvis", folder, images, tuple(frames), cloud, notes=notes, readings=_turned())


def read_e57(path: Path, options: DataOptions) -> Capture:
    """Read panoramas, poses and points of an E57 file, or of all in a folder.

    The images are written to the folder NAME_images beside the file, once; edited ones stay. A DataError says that
    pye57 is missing, that the file is damaged, or that it holds no panoramas or no poses.
    """
    files = [path] if path.is_file() else files_with(path, ".e57")
    if not files:
        raise DataError(f"{path} holds no .e57 file")
    if options.images is not None:
        raise DataError(f"data.images={options.images}: E57 files hold their images; edit those written beside them")
    root, named = path.parent if path.is_file() else path, listed(file.name for file in files)
    frames: list[Frame] = []
    others: list[str] = []
    edited: list[str] = []
    clouds: list[Cloud] = []
    notes: list[str] = []
    folder = root / f"{files[0].stem}_images" if len(files) == 1 else root
    written: dict[str, str] = {}
    with suppress(OSError, ValueError, TypeError):
        written |= json.loads((folder / WRITTEN).read_text(encoding="utf-8"))
    for file in files:
        inside = "" if len(files) == 1 else f"{file.stem}_images/"
        with open_e57(file) as opened:
            for index, (name, image) in enumerate(_named_images(opened)):
                where = f"images2D[{index}] {name!r} of {file}"
                frame = _frame(image, where, folder, f"{inside}{name}", written, edited)
                frames += [frame] if frame else []
                others += [] if frame else [name]
        if options.points == "auto":
            cloud, more = read_cloud(file)
            clouds.append(cloud)
            notes += more
    if others:
        notes.append(f"{len(others)} images of {named} are no whole panoramas and are not used: {listed(others)}")
    if not frames:
        raise DataError(
            f"{named} holds no whole panorama (images2D with a sphericalRepresentation); export panoramas and their "
            "poses too, or use the file as points of another data set (data.points)"
        )
    notes.append(f"images: {len(frames)} panoramas of {named}, written beside it")
    with suppress(OSError):  # a read-only folder, which has all pictures
        write_atomically(folder / WRITTEN, json.dumps(written).encode())
    if edited:
        notes.append(f"images: {listed(edited)} differ from those of {named}, and stay; remove them to get these back")
    cloud, more = joined(clouds)
    notes += more
    cloud = cloud if len(cloud.points) else None
    return Capture("e57", root, folder, tuple(frames), cloud, notes=tuple(notes), readings=_turned())


def _named_images(opened: Any) -> Iterator[tuple[str, Any]]:
    """Yield the entries of images2D with their names, numbered where one occurs twice."""
    taken: set[str] = set()
    entries = opened.root["images2D"] if opened.root.isDefined("images2D") else ()
    for index in range(entries.childCount() if entries else 0):
        image = entries[index]
        stated = image["name"].value() if image.isDefined("name") else ""
        name = "".join(c if c.isalnum() or c in " -_." else "_" for c in stated).strip(" .")[:100] or f"{index:05d}"
        key = re.sub(r"\.(jpe?g|png)$", "", name.casefold())
        name = f"{name}_{index:05d}" if key in taken else name
        taken.add(key)
        yield name, image


def _frame(image: Any, where: str, folder: Path, name: str, written: dict[str, str], edited: list[str]) -> Frame | None:
    """Write the picture of a panorama, unless it is there, and return its frame; None for other images.

    `written` are the digests of pictures by name. Other pictures stay; their names go to `edited`.
    """
    if not image.isDefined("sphericalRepresentation"):
        return None
    sphere = image["sphericalRepresentation"]
    sizes = ("imageWidth", "pixelWidth")  # pixels, radians a pixel
    turn = math.prod(sphere[of].value() for of in sizes) if all(map(sphere.isDefined, sizes)) else 0.0
    if turn > 0 and all(abs(turn / whole - 1) > 0.01 for whole in (2 * math.pi, 360)):  # some state degrees
        return None  # a part of the sphere
    kind = next((kind for kind in ("jpegImage", "pngImage") if sphere.isDefined(kind)), None)
    if kind is None:
        raise DataError(f"{where} has neither jpegImage nor pngImage; export the panoramas as JPEG")
    if not image.isDefined("pose") or not image.isDefined("pose/translation"):
        raise DataError(f"{where} has no pose; export the panoramas with poses, or run `padgs prepare` on the images")
    pose = image["pose"]
    turn = [pose["rotation"][axis].value() for axis in "wxyz"] if pose.isDefined("rotation") else [1.0, 0.0, 0.0, 0.0]
    center = [pose["translation"][axis].value() for axis in "xyz"]
    suffix = ".jpg" if kind == "jpegImage" else ".png"
    name = name if name.lower().endswith((suffix, ".jpeg")) else f"{name}{suffix}"
    edited += _write_blob(sphere[kind], folder, name, written)
    if sphere.isDefined("imageMask"):
        edited += _write_blob(sphere["imageMask"], folder, f"{name.rpartition('.')[0]}_mask.png", written)
    found = cam_from_panorama(torch.tensor(turn, dtype=torch.float64), torch.tensor(center, dtype=torch.float64), where)
    return Frame(name, folder / name, found)


def _write_blob(blob: Any, folder: Path, name: str, written: dict[str, str]) -> list[str]:
    """Write a picture and note its digest; return its name instead if one is there that padgs did not write."""
    buffer = np.zeros(blob.byteCount(), np.uint8)
    blob.read(buffer, 0, len(buffer))
    path, data = folder / name, buffer.tobytes()
    digest = hashlib.sha256(data).hexdigest()
    try:
        there = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None
        if there not in (None, digest, written.get(name)):
            return [name]
        if there != digest:  # the folder may be read-only
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, data)
        written[name] = digest
        return []
    except OSError as error:
        why = error.strerror or error
        raise DataError(f"cannot write {path} ({why}); move the E57 file where you may write") from error


def _turned() -> tuple[Reading, ...]:
    """Return the readings in which the centre of an image is along x, y, -x or -y of its panorama.

    Some programs export images turned by quarters, which the colours of points reveal.
    """
    zero, same, readings = torch.zeros(3, dtype=torch.float64), torch.eye(4, dtype=torch.float64), []
    for along, (cosine, sine) in {"x": (1, 0), "y": (0, 1), "-x": (-1, 0), "-y": (0, -1)}.items():
        turn = torch.tensor([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]], dtype=torch.float64)
        readings.append(Reading(f"centres of images along {along} of their poses", rigid(turn, zero), same))
    return tuple(readings)
