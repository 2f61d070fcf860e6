"""E57 files of scanners with panoramas and their poses, as `padgs.data.formats.poses.cam_from_panorama`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from padgs.data.capture import Capture, Cloud, DataError, DataOptions, Frame, listed
from padgs.data.cloud import read_cloud
from padgs.data.formats.navvis import turned
from padgs.data.formats.poses import cam_from_panorama
from padgs.data.scans import open_e57
from padgs.files import write_atomically


def read(path: Path, options: DataOptions) -> Capture:
    """Read panoramas, poses and points of an E57 file, or of all in a folder.

    The images are written to the folder NAME_images beside the file, once.

    Raises:
        DataError: pye57 is missing, the file is damaged, or it holds no panoramas or no poses.
    """
    files = [path] if path.is_file() else sorted(file for file in path.glob("*") if file.suffix.lower() == ".e57")
    if not files:
        raise DataError(f"{path} holds no .e57 file")
    root = path.parent if path.is_file() else path
    frames: list[Frame] = []
    others: list[str] = []
    clouds: list[Cloud] = []
    notes: list[str] = []
    folder = root / f"{files[0].stem}_images" if len(files) == 1 else root
    for file in files:
        inside = "" if len(files) == 1 else f"{file.stem}_images/"
        with open_e57(file) as opened:
            for index, (name, image) in enumerate(_named_images(opened)):
                frame = _frame(image, f"images2D[{index}] {name!r} of {file}", folder, f"{inside}{name}")
                frames += [frame] if frame else []
                others += [] if frame else [name]
        if options.points == "auto":
            cloud, more = read_cloud(file)
            clouds += [cloud] if len(cloud.points) else []
            notes += more
    if others:
        notes.append(f"{len(others)} images of {files[0].name} are no panoramas and are not used: {listed(others)}")
    if not frames:
        raise DataError(
            f"{listed(file.name for file in files)} holds no panorama (images2D with a sphericalRepresentation); "
            "export panoramas and their poses too, or use the file as points of another data set (data.points)"
        )
    notes.append(f"images: {len(frames)} panoramas of {listed(file.name for file in files)}, written beside it")
    cloud = None
    if clouds:
        paint = [cloud.colors for cloud in clouds]
        whole = (
            torch.cat([color for color in paint if color is not None]) if all(c is not None for c in paint) else None
        )
        cloud = Cloud(torch.cat([cloud.points for cloud in clouds]), whole)
    return Capture("e57", root, folder, tuple(frames), cloud, notes=tuple(notes), readings=turned())


def _named_images(opened: Any) -> Iterator[tuple[str, Any]]:
    """Yield the entries of images2D with their names, numbered where one occurs twice."""
    taken: set[str] = set()
    entries = opened.root["images2D"] if opened.root.isDefined("images2D") else ()
    for index in range(entries.childCount() if entries else 0):
        image = entries[index]
        stated = image["name"].value() if image.isDefined("name") else ""
        name = "".join(c if c.isalnum() or c in " -_." else "_" for c in stated).strip(" .")[:100] or f"{index:05d}"
        name = f"{name}_{index:05d}" if name.casefold() in taken else name
        taken.add(name.casefold())
        yield name, image


def _frame(image: Any, where: str, folder: Path, name: str) -> Frame | None:
    """Write the picture of a panorama, unless it is there, and return its frame; None for other images."""
    if not image.isDefined("sphericalRepresentation"):
        return None
    sphere = image["sphericalRepresentation"]
    kind = next((kind for kind in ("jpegImage", "pngImage") if sphere.isDefined(kind)), None)
    if kind is None:
        raise DataError(f"{where} has neither jpegImage nor pngImage; export the panoramas as JPEG")
    if not image.isDefined("pose") or not image.isDefined("pose/translation"):
        raise DataError(
            f"{where} has no pose; export the panoramas with poses, or run `padgs prepare` on the images alone"
        )
    pose = image["pose"]
    turn = [pose["rotation"][axis].value() for axis in "wxyz"] if pose.isDefined("rotation") else [1.0, 0.0, 0.0, 0.0]
    center = [pose["translation"][axis].value() for axis in "xyz"]
    suffix = ".jpg" if kind == "jpegImage" else ".png"
    name = name if name.lower().endswith((suffix, ".jpeg")) else f"{name}{suffix}"
    _write_blob(sphere[kind], folder / name)
    if sphere.isDefined("imageMask"):
        _write_blob(sphere["imageMask"], (folder / name).with_name(f"{Path(name).stem}_mask.png"))
    found = cam_from_panorama(torch.tensor(turn, dtype=torch.float64), torch.tensor(center, dtype=torch.float64), where)
    return Frame(name, folder / name, found)


def _write_blob(blob: Any, path: Path) -> None:
    data = np.zeros(blob.byteCount(), np.uint8)
    blob.read(data, 0, len(data))
    try:
        if path.is_file() and path.read_bytes() == data.tobytes():  # the folder may be read-only
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, data.tobytes())
    except OSError as error:
        raise DataError(
            f"cannot write {path} ({error.strerror or error}); move the E57 file where you may write"
        ) from error
