"""OpenMVG's `sfm_data.json` with a spherical camera: views, intrinsics, extrinsics, structure.

An extrinsic holds the rotation cam_from_world (row-major) and the camera centre in the world; camera axes are those of
`padgs.geometry.panorama`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from torch import Tensor

from padgs.data.assemble import image_folder
from padgs.data.capture import Capture, Cloud, DataError, DataOptions, Frame, Tracks
from padgs.data.cloud import first_ply
from padgs.data.formats.json_file import Json, file_in, read_json
from padgs.data.formats.poses import cam_from_center
from padgs.data.splits import check_name

_PLY = ("colorized.ply", "scene.ply", "pcd.ply")


def read(path: Path, options: DataOptions) -> Capture:
    """Read `sfm_data.json`. Its points have no colours; a colorized.ply beside it is preferred."""
    file = file_in(path, "sfm_data.json")
    folder, data = file.parent, read_json(file)
    _check_cameras(data)
    views, poses = read_views(data), read_extrinsics(data)
    # The image folder on the machine of the reconstruction; only its last name is used, because a file from elsewhere
    # must not reach other folders.
    stated = data.get("root_path")
    root = PurePosixPath(stated.text().replace("\\", "/")).name if stated else ""
    images = image_folder(folder, options.images, ("images", "imgs", *([root] if root not in ("", "..") else [])))
    posed = [view for view in views if view.pose in poses]
    frames = tuple(Frame(view.name, images / view.name, poses[view.pose], view.width, view.height) for view in posed)
    stated = data.get("structure")
    structure = stated.entries() if stated else []
    colored = first_ply(folder, _PLY)
    cloud = colored
    if cloud is None and structure:
        points = Json([item["value"]["X"].value for item in structure], f"X of the structure of {file}")
        cloud = Cloud(points.numbers(len(structure), 3), None)
    return Capture(
        format="openmvg",
        folder=folder,
        image_folder=images,
        frames=frames,
        cloud=cloud,
        tracks=(lambda: _tracks(structure, {view.key: i for i, view in enumerate(posed)})) if colored is None else None,
        notes=() if colored is None else ("points: from the PLY file beside sfm_data.json, which has colours",),
    )


@dataclass(frozen=True)
class MvgView:
    """An entry of `views`."""

    key: int
    pose: int  # id_pose
    name: str  # local_path/filename
    width: int
    height: int


def read_views(data: Json) -> list[MvgView]:
    """Read the entries of `views`, in the file's order."""
    views = []
    for item in data["views"].entries():
        view = item["value"]["ptr_wrapper"]["data"]
        local, name = view.get("local_path"), view["filename"].text()
        folder = local.text().strip("/") if local else ""
        name = check_name(f"{folder}/{name}" if folder else name, data.where)
        key = item["key"].whole()
        pose = view.get("id_pose") or item["key"]
        views.append(MvgView(key, pose.whole(), name, view["width"].whole(), view["height"].whole()))
    return views


def read_extrinsics(data: Json) -> dict[int, Tensor]:
    """Read the extrinsics: pose key -> cam_from_world [4, 4] float64."""
    poses = {}
    for item in data["extrinsics"].entries():
        key = item["key"].whole()
        pose = Json(item["value"].value, f"extrinsic {key} of {data.where}")
        poses[key] = cam_from_center(pose["rotation"].numbers(3, 3), pose["center"].numbers(3), pose.where)
    if not poses:
        raise DataError(
            f"{data.where} holds no extrinsics; export them too (openMVG_main_ConvertSfM_DataFormat -V -I -E -S)"
        )
    return poses


def _check_cameras(data: Json) -> None:
    """Refuse cameras that are not spherical; cereal names a class only where it first occurs."""
    for item in data["intrinsics"].entries():
        name = item["value"].get("polymorphic_name")
        if name and name.text() != "spherical":
            raise DataError(
                f"{data.where} holds a {name.text()!r} camera; only spherical cameras (panoramas) can be used"
            )


def _tracks(structure: list[Json], frame_of_view: dict[int, int]) -> Tracks:
    return Tracks.from_observations(
        (frame_of_view[key], point, seen["value"]["x"].numbers(2).tolist())
        for point, item in enumerate(structure)
        if (observations := item["value"].get("observations"))
        for seen in observations.entries()
        if (key := seen["key"].whole()) in frame_of_view
    )
