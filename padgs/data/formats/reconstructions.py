"""JSON files of structure from motion with spherical cameras, whose axes are those of `padgs.geometry.panorama`.

OpenMVG: `sfm_data.json` with views, intrinsics, extrinsics (rotation cam_from_world, row-major, and camera centre) and
structure. Released PaD-GS and ODGS code splits it: data_views.json, data_extrinsics.json, pcd.ply (or colorized.ply),
train.txt and test.txt; image sizes are not stated. OpenSfM: `reconstruction.json` with the rotation vector and
translation of cam_from_world in each shot.
"""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import torch
from torch import Tensor

from padgs.data.assemble import image_folder
from padgs.data.camera_paths import centers
from padgs.data.capture import Capture, Cloud, DataError, DataOptions, Frame, Tracks, UnknownLens, by_id
from padgs.data.cloud import color_bytes, first_ply, forgiving, whole_if_possible
from padgs.data.formats.json_file import Json, file_in, read_json
from padgs.data.formats.poses import cam_from_center, cam_from_world, rotation_from_vector
from padgs.data.splits import check_name

AT_CAMERA = 1e-4  # of the largest distance of a camera to their mean: rounding of text files
CEREAL_ID = 2**31 - 1  # bits of a polymorphic_id that number the class; the highest marks its first object


class MvgView(NamedTuple):
    """An entry of OpenMVG's `views`."""

    key: int
    pose: int  # id_pose
    name: str  # local_path/filename
    size: tuple[int, int]  # width, height
    intrinsic: int | None  # id_intrinsic


def read_openmvg(path: Path, options: DataOptions) -> Capture:
    """Read `sfm_data.json`. Its points have no colours; a colorized.ply beside it is preferred."""
    file = file_in(path, "sfm_data.json")
    folder, data = file.parent, read_json(file)
    views, poses = _mvg_views(data), _mvg_poses(data)
    posed = [view for view in views if view.pose in poses]
    names: dict[int, str] = {}  # of classes
    lenses: dict[int | None, UnknownLens | None] = {}  # by intrinsic; of views without one: that of any other camera
    for item in data["intrinsics"].entries():  # cereal names a class only where it first occurs
        value = item["value"]
        number = value["polymorphic_id"].whole() & CEREAL_ID if value.get("polymorphic_id") else 0
        if name := value.get("polymorphic_name"):
            names[number] = name.text()
        kind = names.get(number, "spherical")
        if kind != "spherical":
            unknown = UnknownLens(f"{file} holds a {kind!r} camera; only spherical cameras (panoramas) can be used")
            lenses[None] = lenses[item["key"].whole()] = unknown
    # The image folder on the machine of the reconstruction; only its last name is used, because a file from elsewhere
    # must not reach other folders.
    stated = data.get("root_path")
    root = PurePosixPath(stated.text().replace("\\", "/")).name if stated else ""
    images = image_folder(folder, options.images, ("images", "imgs", *({root} - {"", ".."})))
    frames = tuple(
        Frame(view.name, images / view.name, poses[view.pose], *view.size, lens=lenses.get(view.intrinsic))
        for view in posed
    )
    if colored := first_ply(folder, ("colorized.ply", "scene.ply", "pcd.ply"), options.points):
        note = "points: from the PLY file beside sfm_data.json, which has colours"
        return Capture("openmvg", folder, images, frames, _without_cameras(colored, frames), notes=(note,))
    stated = data.get("structure")
    structure = stated.entries() if stated else []
    points = Json([item["value"]["X"].value for item in structure], f"X of the structure of {file}")
    cloud = Cloud(points.numbers(len(structure), 3), None) if structure else None

    def tracks() -> Tracks:
        frame_of_view = {view.key: i for i, view in enumerate(posed)}
        return Tracks.from_observations(
            (frame_of_view[key], point, seen["value"]["x"].numbers(2).tolist())
            for point, item in enumerate(structure)
            if (observations := item["value"].get("observations"))
            for seen in observations.entries()
            if (key := seen["key"].whole()) in frame_of_view
        )

    return Capture("openmvg", folder, images, frames, cloud, tracks=tracks)


def read_released(path: Path, options: DataOptions) -> Capture:
    """Read a folder of the released PaD-GS or ODGS code. Views and extrinsics are joined by the key of the pose."""
    views = _mvg_views(read_json(file_in(path, "data_views.json")))
    poses = _mvg_poses(read_json(file_in(path, "data_extrinsics.json")))
    images = image_folder(path, options.images)
    frames = tuple(Frame(view.name, images / view.name, poses[view.pose]) for view in views if view.pose in poses)
    cloud = first_ply(path, ("pcd.ply", "colorized.ply"), options.points)
    return Capture("released", path, images, frames, cloud and _without_cameras(cloud, frames))


def _without_cameras(cloud: Cloud, frames: Sequence[Frame]) -> Cloud:
    """Return a cloud without the green points at the cameras, which OpenMVG adds to colorized.ply."""
    if cloud.colors is None or not frames:
        return cloud
    green = (cloud.colors == torch.tensor([0, 255, 0], dtype=torch.uint8)).all(1).nonzero()[:, 0]
    places = centers(torch.stack([frame.cam_from_world for frame in frames]))
    near = torch.cdist(cloud.points[green].double(), places).amin(1)
    kept = torch.ones(len(cloud.points), dtype=torch.bool)
    kept[green[near <= AT_CAMERA * (places - places.mean(0)).norm(dim=1).max()]] = False
    return Cloud(cloud.points[kept], cloud.colors[kept])


def _mvg_views(data: Json) -> list[MvgView]:
    views = []
    for item in data["views"].entries():
        view, key = item["value"]["ptr_wrapper"]["data"], item["key"]
        local, name = view.get("local_path"), view["filename"].text()
        folder = local.text().strip("/") if local else ""
        name = check_name(f"{folder}/{name}" if folder else name, data.where)
        size = view["width"].whole(), view["height"].whole()
        camera = view.get("id_intrinsic")
        views.append(MvgView(key.whole(), (view.get("id_pose") or key).whole(), name, size, camera and camera.whole()))
    return list(by_id(((view.key, view) for view in views), f"views of {data.where}").values())


def _mvg_poses(data: Json) -> dict[int, Tensor]:
    """Read the extrinsics: pose key -> cam_from_world [4, 4] float64."""
    found = [(item["key"].whole(), item["value"].value) for item in data["extrinsics"].entries()]
    poses = {}
    for key, value in by_id(found, f"extrinsics of {data.where}").items():
        pose = Json(value, f"extrinsic {key} of {data.where}")
        poses[key] = cam_from_center(pose["rotation"].numbers(3, 3), pose["center"].numbers(3), pose.where)
    if not poses:
        export = "openMVG_main_ConvertSfM_DataFormat -V -I -E -S"
        raise DataError(f"{data.where} holds no extrinsics; export them too ({export})")
    return poses


def read_opensfm(path: Path, options: DataOptions) -> Capture:
    """Read the reconstruction with the most shots."""
    file = file_in(path, "reconstruction.json")
    if not (parts := read_json(file).entries()):
        raise DataError(f"{file} must hold a list of reconstructions with at least one in it")
    best = max(parts, key=lambda part: len(part["shots"].items()))
    images = image_folder(file.parent, options.images)
    frames = []
    for name, value in best["shots"].items().items():
        shot = Json(value.value, f"shot {check_name(name, str(file))} of {file}")
        camera = best["cameras"][shot["camera"].text()]
        model = camera["projection_type"].text()
        unknown = UnknownLens(f"{shot.where} has a {model!r} camera; only spherical cameras (panoramas) can be used")
        lens = None if model in ("spherical", "equirectangular") else unknown
        rotation = rotation_from_vector(shot["rotation"].numbers(3), shot.where)
        pose = cam_from_world(rotation, shot["translation"].numbers(3), shot.where)
        width, height = (side and side.whole() for side in (camera.get("width"), camera.get("height")))
        frames.append(Frame(name, images / name, pose, width, height, lens=lens))
    used = f"{file.name} holds {len(parts)} reconstructions; the one with the most shots, {len(frames)}, is used"
    notes, cloud = (used,) if len(parts) > 1 else (), None
    with forgiving(options.points):
        cloud = _opensfm_cloud(best)
    return Capture("opensfm", file.parent, images, tuple(frames), cloud, notes=notes)


def _opensfm_cloud(part: Json) -> Cloud | None:
    """Return the points, without those that lack a colour if others have one."""
    stated = part.get("points")
    points = list(stated.items().values()) if stated else []
    if not points:
        return None
    points = [point for point in points if point.get("color")] or points
    where, colors = f"the points of {part.where}", None
    positions = Json([point["coordinates"].value for point in points], where)
    if paint := [color.value for point in points if (color := point.get("color"))]:
        values = Json(paint, f"color of {where}").numbers(len(points), 3)
        colors = color_bytes(whole_if_possible(values.numpy()), where)
    return Cloud(positions.numbers(len(points), 3), colors)
