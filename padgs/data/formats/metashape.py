"""Metashape's `cameras.xml` with spherical sensors, and a PLY cloud beside it.

The transform of a camera is its pose in its component: 16 numbers, row by row, of a camera with the axes of
`padgs.geometry.panorama`. Components and the chunk have similarities (rotation, translation, scale):
world = chunk x component x camera. A file without any of them is in the chunk's own frame, whose scale is arbitrary.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as XML

import torch
from torch import Tensor

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, DataError, DataOptions, Frame, Reading, UnknownLens, by_id, files_with, listed
from padgs.data.cloud import read_ply
from padgs.data.formats.poses import cam_from_pose, rigid
from padgs.data.images import read_bytes
from padgs.data.splits import check_name

_PLY = ("points.ply", "point_cloud.ply", "cloud.ply", "dense.ply", "sparse.ply")


def find_xml(path: Path) -> Path | None:
    """Return the file of cameras: `path` itself, cameras.xml in it, or the only XML file with a chunk in it."""
    if path.is_file() or (path / "cameras.xml").exists():
        return path if path.is_file() else path / "cameras.xml"
    found = xml_files(path)
    return found[0] if len(found) == 1 else None


def xml_files(path: Path) -> list[Path]:
    """Return the XML files in a folder that have a chunk; in UTF-16 every second byte is 0."""
    return [file for file in files_with(path, ".xml") if b"<chunk" in file.read_bytes()[:8192].replace(b"\0", b"")]


def read(path: Path, options: DataOptions) -> Capture:
    """Read the enabled and aligned cameras of the chunk with most of them.

    A DataError: no XML, no aligned camera, a sensor that is not spherical, or components without a common frame.
    """
    if (file := find_xml(path)) is None:
        raise DataError(f"{path} holds no cameras.xml; export it in Metashape: File > Export > Export Cameras")
    try:
        root = XML.fromstring(read_bytes(file))
    except (XML.ParseError, ValueError, LookupError) as error:
        raise DataError(f"{file} is not valid XML ({error}); export the cameras again") from error
    chunks = root.findall("chunk") if root.tag == "document" else []
    if not chunks:
        raise DataError(f"{file} holds no <chunk> in a <document>; it must be an export of Metashape's cameras as XML")
    usable = {chunk: sum(map(_is_usable, chunk.iter("camera"))) for chunk in chunks}
    chunk = max(chunks, key=lambda chunk: (usable[chunk] > 0, _is_on(chunk), usable[chunk]))
    notes = [f"{file.name} holds {len(chunks)} chunks; {chunk.get('label')!r} is used"] if len(chunks) > 1 else []
    folder = image_folder(file.parent, options.images)
    every = list(_cameras(chunk))
    on = [(name, camera) for name, camera in every if _is_on(camera)]
    aligned = [(name, camera) for name, camera in on if _is_usable(camera)]
    if len(on) < len(every):
        notes.append(f"{len(every) - len(on)} cameras are disabled in Metashape and not used")
    if len(aligned) < len(on):
        names = listed(name for name, camera in on if camera.find("transform") is None)
        notes.append(f"{len(on) - len(aligned)} cameras have no <transform> (not aligned) and are not used: {names}")
    if not aligned:
        raise DataError(f"{file} holds no enabled camera with a <transform>; align the photos, and export again")
    _refuse_twins([name for name, _ in aligned], file)
    sensors = _sensors(chunk, {camera.get("sensor_id", "") for _, camera in aligned}, file)
    components = _components(chunk, {camera.get("component_id", "") for _, camera in aligned}, file)
    outer, where = chunk.find("transform"), f"<transform> of the chunk in {file}"
    same = torch.eye(4, dtype=torch.float64)
    world = same if outer is None else _similarity(outer, where)
    frames = []
    for name, camera in aligned:
        where = f"<transform> of camera {name!r} in {file}"
        inner = components[camera.get("component_id", "")]
        cam = cam_from_pose(_numbers(camera.find("transform"), 16, where).reshape(4, 4), where)
        pose = world @ inner @ torch.linalg.inv(cam)
        pose[:3, :3] /= torch.linalg.det(pose[:3, :3]) ** (1 / 3)
        frames.append(Frame(name, folder / name, cam_from_pose(pose, where), **sensors[camera.get("sensor_id", "")]))
    if outer is None and all(matrix.equal(same) for matrix in components.values()):
        notes.append(f"{file.name} has no <transform> of a chunk or component: lengths are in the chunk's own unit")
    plys = [file.parent / name for name in _PLY if (file.parent / name).is_file()] or files_with(file.parent, ".ply")
    plys = plys if options.points == "auto" else []  # else a missing or damaged file does not matter
    if len(plys) > 1:
        notes.append(f"points: {plys[0].name}, not {listed(ply.name for ply in plys[1:])}; set data.points to choose")
    # In which frame a cloud was exported is not stated in its file; Metashape's own choice is the world.
    readings = [("points in the frame of the world", same), ("points in the frame of the chunk", world)]
    if len(components) == 1:
        readings.append(("points in the frame of the component", world @ next(iter(components.values()))))
    cloud = read_ply(plys[0]) if plys else None
    possible = tuple(Reading(words, same, matrix) for words, matrix in readings)
    return Capture("metashape", file.parent, folder, tuple(frames), cloud, notes=tuple(notes), readings=possible)


def _is_on(element: XML.Element) -> bool:
    return element.get("enabled", "true").lower() not in ("false", "0")


def _is_usable(camera: XML.Element) -> bool:
    return _is_on(camera) and camera.find("transform") is not None


def _cameras(chunk: XML.Element) -> Iterator[tuple[str, XML.Element]]:
    """Yield the cameras and their names: labels, after that of their group where one label occurs twice."""
    groups = {camera: group.get("label", "") for group in chunk.iter("group") for camera in group.iter("camera")}
    cameras = [camera for part in chunk.findall("cameras") for camera in part.iter("camera")]
    count = Counter(camera.get("label", "") for camera in cameras)
    for camera in cameras:
        label = camera.get("label", "")
        yield (f"{groups[camera]}/{label}" if count[label] > 1 and groups.get(camera) else label), camera


def _refuse_twins(names: list[str], file: Path) -> None:
    for name in names:
        if not check_name(name, str(file)):
            raise DataError(f"{file} holds a camera without label; its label must be the name of its panorama")
    if twins := [name for name, count in Counter(names).items() if count > 1]:
        raise DataError(
            f"{file} holds several cameras with the label {listed(twins)}; in Metashape, put the photos of each folder "
            "into a camera group that is named like the folder, or rename the photos"
        )


def _sensors(chunk: XML.Element, used: set[str], file: Path) -> dict[str, dict[str, Any]]:
    """Return what the used sensors say of a `Frame`, by id: width and height; if not spherical, the lens."""
    stated = ((sensor.get("id", ""), sensor) for sensor in chunk.findall("sensors/sensor"))
    found, sensors = {}, by_id(stated, f"<sensors> of {file}")
    for key in sorted(used):
        if key not in sensors:
            raise DataError(f"{file}: cameras use <sensor id={key!r}>, which is not in <sensors>; export them again")
        where, kind = f"<sensor id={key!r} label={sensors[key].get('label')!r}>", sensors[key].get("type")
        if (kind or "").lower() != "spherical":
            rule = "only 'spherical' sensors (panoramas) can be used, set in Tools > Camera Calibration > Type"
            found[key] = {"lens": UnknownLens(f"{file}: {where} has the type {kind!r}; {rule}")}
            continue
        size = sensors[key].find("resolution")
        try:
            assert size is not None
            found[key] = {"width": int(size.get("width", "")), "height": int(size.get("height", ""))}
        except (AssertionError, ValueError) as error:
            raise DataError(f"{file}: {where} lacks <resolution width= height=>; export the cameras again") from error
    return found


def _components(chunk: XML.Element, used: set[str], file: Path) -> dict[str, Tensor]:
    """Return the similarity of each used component by id, that of its cameras to the chunk."""
    known = {component.get("id", ""): component for component in chunk.findall("components/component")}
    found, free = {}, []
    for key in sorted(used):
        element = known[key].find("transform") if key in known else None
        if element is None:
            free.append(key or "none")
        where = f"<transform> of component {key} in {file}"
        found[key] = torch.eye(4, dtype=torch.float64) if element is None else _similarity(element, where)
    if len(used) > 1 and free:
        raise DataError(
            f"{file}: cameras are in {len(used)} components, and component {listed(free)} has no <transform>, so their "
            "places relative to each other are unknown; align and merge the components in Metashape, or disable all "
            "cameras but those of one component"
        )
    return found


def _similarity(element: XML.Element, where: str) -> Tensor:
    """Read a similarity [4, 4]: rotation, translation and scale, or 16 numbers."""
    if element.find("rotation") is None:
        matrix = _numbers(element, 16, where).reshape(4, 4)
        scale = torch.linalg.det(matrix[:3, :3]).abs() ** (1 / 3)
    else:
        rotation = _numbers(element.find("rotation"), 9, f"<rotation> of {where}").reshape(3, 3)
        translation = _numbers(element.find("translation"), 3, f"<translation> of {where}")
        stated = element.find("scale")
        scale = torch.ones(()) if stated is None else _numbers(stated, 1, f"<scale> of {where}")[0]
        matrix = rigid(scale * rotation, translation)
    if not scale > 0:
        raise DataError(f"{where}: the scale is {scale.item():g}; it must be positive")
    axes = torch.tensor([*3 * [scale.item()], 1.0], dtype=torch.float64)  # of each column
    return torch.linalg.inv(cam_from_pose(matrix / axes, where)) * axes


def _numbers(element: XML.Element | None, count: int, where: str) -> Tensor:
    words = (element.text or "").split() if element is not None else []
    try:
        numbers = torch.tensor([float(word) for word in words], dtype=torch.float64)
    except ValueError as error:
        raise DataError(f"{where}: {error}; export the cameras again") from error
    if len(numbers) != count or not numbers.isfinite().all():
        raise DataError(f"{where} must hold {count} finite numbers, not {' '.join(words)[:60]!r}; export it again")
    return numbers
