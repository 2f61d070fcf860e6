"""nerfstudio's `transforms.json` (and the pair transforms_train.json, transforms_test.json) of EQUIRECTANGULAR cameras.

Poses are world from camera, with OpenGL axes: x right, y up, z backward.
"""

from dataclasses import replace
from pathlib import Path, PurePosixPath
from posixpath import commonpath

import torch

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, DataError, DataOptions, Frame, Reading, UnknownLens, first_of, listed
from padgs.data.cloud import read_ply
from padgs.data.depths import HOW
from padgs.data.formats import detect
from padgs.data.formats.json_file import Json, file_in, read_json
from padgs.data.formats.poses import cam_from_opengl_pose
from padgs.data.splits import is_inside
from padgs.files import IMAGE_FOLDERS, given_path

FILE = "transforms.json"
REDUCED = "reduce_to"  # `Capture.width`, as `padgs split` states it
SIDES = {"train": ("transforms_train.json",), "test": ("transforms_test.json", "transforms_val.json")}
MODELS = ("EQUIRECTANGULAR", "SPHERICAL")
LICHTFELD = "pointcloud.ply"  # LichtFeld Studio turns the cameras of panoramas, but not the points
_PLY = ("sparse_pc.ply", "points3d.ply", "points3D.ply", "pcd.ply", "scene.ply", LICHTFELD)
_SAME, _TURNED = (torch.diag(torch.tensor([x, 1, x, 1], dtype=torch.float64)) for x in (1, -1))
_READINGS = (
    Reading("the points are in the world of the poses", _SAME, _SAME),
    Reading("the points are turned by 180 degrees about y, as for LichtFeld Studio", _SAME, _TURNED),
)


def read(path: Path, options: DataOptions) -> Capture:
    """Read `transforms.json`, or the pair of files for train and test (else val).

    A DataError: another camera model, an invalid pose, or a path outside the folder.
    """
    file = file_in(path, FILE)
    folder = file.parent
    sides = {side: part for side, names in SIDES.items() if (part := first_of(folder, names))}
    metas = {"": read_json(file)} if file.exists() else {side: read_json(part) for side, part in sides.items()}
    if not metas:
        raise DataError(f"{folder} holds neither {FILE} nor {SIDES['train'][0]} and {SIDES['test'][0]}")
    root = folder if options.images is None else image_folder(folder, options.images)
    frames: list[Frame] = []
    split: dict[str, tuple[str, ...]] = {}
    for side, meta in metas.items():
        entries, reads_masks = meta["frames"].entries(), options.mask in ("auto", "inverted")
        part = [_frame(meta, frame, folder, root, reads_masks=reads_masks) for frame in entries]
        frames += part
        if len(metas) > 1:
            split[side] = tuple(frame.name for frame in part)
    first = next(iter(metas.values()))
    for side in SIDES:
        if "" in metas and (names := first.get(f"{side}_filenames")) and names.entries():
            split[side] = tuple(_name(name) for name in names.entries())
    notes: tuple[str, ...] = ()
    if "" in metas and path != file and sides:  # another program's split of these frames?
        halves = {side: read_json(part)["frames"].entries() for side, part in sides.items()}
        pair = {side: tuple(_name(frame["file_path"]) for frame in half) for side, half in halves.items()}
        if split or not set().union(*pair.values()) <= {frame.name for frame in frames}:
            notes = (f"not used: {listed(part.name for part in sides.values())}; {FILE} has the views",)
        else:
            split = pair
    folders = [str(PurePosixPath(frame.name).parent) for frame in frames if is_inside(frame.name)]
    prefix = commonpath(folders) if folders and len(folders) == len(frames) else ""
    if (top := prefix.partition("/")[0]).lower() in IMAGE_FOLDERS:  # masks and depth maps have the folders below it
        prefix = top
    if prefix:
        frames = [replace(frame, name=frame.name.removeprefix(f"{prefix}/")) for frame in frames]
        split = {side: tuple(name.removeprefix(f"{prefix}/") for name in names) for side, names in split.items()}
    named, mask, stored = first.get("ply_file_path"), first.get("mask"), given_path(options.points, folder)
    if options.points == "auto":  # with another source of points a missing or damaged file does not matter
        stored = named.path_in(folder) if named else first_of(folder, _PLY)
    cloud = read_ply(stored) if stored and options.points == "auto" else None
    is_turned = stored and stored.name.lower() == LICHTFELD and stored.parent.resolve().is_relative_to(folder.resolve())
    readings = _READINGS if is_turned else ()
    meant = mask.text() if mask else "auto"  # as `padgs split` states it
    if len(metas) > 1 and len(unused := [file for name in SIDES["test"] if (file := first_of(folder, (name,)))]) > 1:
        notes = (f"{unused[1].name} is not used: {unused[0].name} has the test views",)
    if any(frame.get("depth_file_path") for meta in metas.values() for frame in meta["frames"].entries()):
        notes += (f"depth: depth_file_path is not read; {HOW}",)
    width = reduced.whole() if (reduced := first.get(REDUCED)) else None
    content = (root / prefix, tuple(frames), cloud, split or None, meant, width)
    return Capture("transforms", folder, *content, readings=readings, notes=notes)


def transforms_file(path: str | None, format: str) -> Path | None:
    """Return the `transforms.json` behind `data.path` and `data.format`; None for others, a DataError for none."""
    if path is None or (detect(Path(path))[0] if format == "auto" else format) not in ("transforms", "nerfstudio"):
        return None
    file = file_in(Path(path), FILE)
    return file if file.is_file() else None


def _frame(meta: Json, frame: Json, folder: Path, root: Path, *, reads_masks: bool) -> Frame:
    name = _name(frame["file_path"])
    stated = frame.get("camera_model") or meta.get("camera_model")
    model = stated and stated.text()
    rule = "only EQUIRECTANGULAR panoramas can be used (set camera_model if these are panoramas)"
    unknown = UnknownLens(f"{meta.where}: {name} has camera_model {model!r}; {rule}")
    lens = None if model and model.upper() in MODELS else unknown
    matrix = Json(frame.value, f"{name} in {meta.where}")["transform_matrix"]
    mask = frame.get("mask_path") if reads_masks else None
    width, height = (side and side.whole() for side in (frame.get(key) or meta.get(key) for key in ("w", "h")))
    pose = cam_from_opengl_pose(matrix.numbers(), matrix.where)
    stated = frame.get("share") or Json(1.0, "share")
    share = stated.numbers()
    if share.ndim or not 0 < share <= 1:
        raise DataError(f"{stated.where} is {stated.value}; it must be a number above 0 and at most 1, for each pass")
    return Frame(name, root / name, pose, width, height, mask and mask.path_in(folder), share=share.item(), lens=lens)


def _name(path: Json) -> str:
    return str(PurePosixPath(path.name().replace("\\", "/")))
