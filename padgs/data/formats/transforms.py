"""nerfstudio's `transforms.json` (and the pair transforms_train.json, transforms_test.json) of EQUIRECTANGULAR cameras.

Poses are world from camera, for a camera of OpenGL's axes: x right, y up, z backward.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from padgs.data.capture import Capture, Frame
from padgs.data.cloud import existing_ply
from padgs.data.errors import DataError
from padgs.data.formats.json_file import entries, entry, numbers, read_json
from padgs.data.formats.poses import cam_from_opengl_pose
from padgs.data.images import EXTENSIONS
from padgs.data.options import DataOptions
from padgs.data.ply import read_ply
from padgs.data.splits import check_inside

FILE = "transforms.json"
SIDES = {"train": "transforms_train.json", "test": "transforms_test.json"}
MODELS = ("EQUIRECTANGULAR", "SPHERICAL")
_PLY = ("sparse_pc.ply", "points3d.ply", "points3D.ply", "pcd.ply", "scene.ply")


def read(path: Path, options: DataOptions) -> Capture:
    """Read `transforms.json`, or the pair of files for train and test.

    Raises:
        DataError: another camera model, a pose that is none, a path outside the folder.
    """
    folder = path.parent if path.is_file() else path
    file = path if path.is_file() else folder / FILE
    files = (
        {"": file}
        if file.is_file()
        else {side: folder / name for side, name in SIDES.items() if (folder / name).is_file()}
    )
    if not files:
        raise DataError(f"{folder} holds neither {FILE} nor {' and '.join(SIDES.values())}")
    metas = {side: read_json(one) for side, one in files.items()}
    root = folder if options.images is None else folder / options.images
    frames: list[Frame] = []
    split: dict[str, tuple[str, ...]] = {}
    for side, meta in metas.items():
        part = [_frame(meta, frame, root, files[side]) for frame in entries(meta, "frames", str(files[side]))]
        frames += part
        if side:
            split[side] = tuple(frame.name for frame in part)
    for side in ("train", "test"):
        names = metas.get("", {}).get(f"{side}_filenames")
        if names:
            split[side] = tuple(_name(str(name), str(file)) for name in names)
    prefix = _shared_folder([frame.name for frame in frames])
    if prefix:
        frames = [_below(frame, prefix) for frame in frames]
        split = {side: tuple(name.removeprefix(f"{prefix}/") for name in names) for side, names in split.items()}
    first = next(iter(metas.values()))
    named = first.get("ply_file_path")
    cloud = read_ply(folder / check_inside(named, str(file))) if named else existing_ply(folder, _PLY)
    return Capture(
        format="transforms",
        folder=folder,
        image_folder=root / prefix,
        frames=tuple(frames),
        cloud=cloud,
        split=split or None,
    )


def _frame(meta: Mapping[str, Any], frame: Any, root: Path, file: Path) -> Frame:
    name = _name(str(entry(frame, "file_path", f"a frame of {file}")), str(file))
    model = frame.get("camera_model", meta.get("camera_model"))
    if model not in MODELS:
        raise DataError(
            f"{file}: {name} has camera_model {model!r}; only EQUIRECTANGULAR panoramas can be used "
            "(set camera_model if these are panoramas)"
        )
    if not PurePosixPath(name).suffix:  # as in Blender's files
        found = [f"{name}{extension}" for extension in EXTENSIONS if (root / f"{name}{extension}").is_file()]
        name = found[0] if found else f"{name}.png"
    where = f"transform_matrix of {name} in {file}"
    rows = entry(frame, "transform_matrix", f"{name} in {file}")
    pose = numbers(rows, (len(rows) if isinstance(rows, list) else 4, 4), where)
    mask = frame.get("mask_path")
    width, height = (frame.get(key, meta.get(key)) for key in ("w", "h"))
    return Frame(
        name=name,
        image=root / name,
        cam_from_world=cam_from_opengl_pose(pose, where),
        width=None if width is None else int(width),
        height=None if height is None else int(height),
        mask=None if mask is None else root / _name(str(mask), str(file)),
    )


def _name(path: str, where: str) -> str:
    return str(PurePosixPath(check_inside(path, where).replace("\\", "/")))


def _shared_folder(names: list[str]) -> str:
    """The folder in which all images lie, "" if there is none: "images" for images/a.jpg, images/b.jpg."""
    folders = {str(PurePosixPath(name).parent) for name in names}
    return folders.pop() if len(folders) == 1 and "." not in folders else ""


def _below(frame: Frame, prefix: str) -> Frame:
    name = frame.name.removeprefix(f"{prefix}/")
    return Frame(name, frame.image, frame.cam_from_world, frame.width, frame.height, frame.mask)
