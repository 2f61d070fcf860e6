"""Writers of all formats: the files beside the images."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from padgs.data.capture import Cloud, DataError, Frame, Tracks, view_name
from padgs.data.cloud import write_ply
from padgs.data.formats.colmap_lens import pycolmap_module
from padgs.data.formats.poses import OPENCV_FROM_OPENGL
from padgs.data.splits import LISTS


@dataclass(frozen=True)
class Content:
    """Data to be written. Frame sizes are those of the image files; names are relative to the image folder."""

    frames: tuple[Frame, ...]
    cloud: Cloud | None
    tracks: Tracks | None
    split: Mapping[str, tuple[str, ...]]  # "train", "test" -> names; empty without test views


def write_colmap(content: Content, folder: Path) -> None:
    """Write a binary model with rigs and frames to sparse/0, and the lists."""
    pycolmap = pycolmap_module()
    if content.cloud is None:
        lacks = "there is no point cloud, and a COLMAP model needs one"
        raise DataError(f"{lacks}; set data.points to a PLY file or random")
    tracks, model = content.tracks or Tracks.from_observations([]), pycolmap.Reconstruction()
    elements: dict[int, list[Any]] = {}  # point -> its track
    cameras: dict[tuple[int, int], int] = {}
    of_frames = tracks.frame.argsort(stable=True).split(tracks.frame.bincount(minlength=len(content.frames)).tolist())
    for image_id, (frame, seen) in enumerate(zip(content.frames, of_frames, strict=True), 1):
        size = _size(frame)
        if size not in cameras:
            cameras[size] = len(cameras) + 1
            camera = {"model": "EQUIRECTANGULAR", "width": size[0], "height": size[1], "params": size}
            model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=cameras[size], **camera))
        pixels = tracks.pixels[seen].numpy()
        image = pycolmap.Image(name=frame.name, keypoints=pixels, camera_id=cameras[size], image_id=image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(frame.cam_from_world[:3].numpy()))
        for index, point in enumerate(tracks.point[seen].tolist()):
            elements.setdefault(point, []).append(pycolmap.TrackElement(image_id, index))
    colors = _colors(content.cloud)
    for k, point in enumerate(content.cloud.points.numpy()):
        model.add_point3D(point[:, None], pycolmap.Track(elements.get(k, [])), colors[k][:, None])
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(str(folder / "sparse" / "0"))
    _write_lists(content, folder)


def write_transforms(content: Content, folder: Path, **more: Any) -> None:
    """Write `transforms.json`, with `more` keys and the masks that are in the folder, and sparse_pc.ply."""
    frames = []
    for frame in content.frames:
        pose = torch.linalg.inv(frame.cam_from_world)
        pose[:3, :3] = pose[:3, :3] @ OPENCV_FROM_OPENGL
        known = {"file_path": f"images/{frame.name}"}
        if frame.width is not None and frame.height is not None:  # the focal length is as nerfstudio has it
            focal = {"fl_x": frame.height, "fl_y": frame.height, "cx": frame.width / 2, "cy": frame.height / 2}
            known |= {"w": frame.width, "h": frame.height, **focal}
        known |= {"share": frame.share} if frame.share != 1 else {}
        frames.append(known | {"transform_matrix": pose.tolist()})
    paths = ["mask.png"] * len(frames), [f"masks/{view_name(frame.name)}.png" for frame in content.frames]
    masks = next((some for some in paths if all((folder / path).is_file() for path in some)), ())
    for known, path in zip(frames, masks, strict=False):  # nerfstudio refuses masks of some frames only
        known["mask_path"] = path
    meta: dict[str, Any] = {"camera_model": "EQUIRECTANGULAR", "frames": frames, **more}
    if content.cloud is not None:
        write_ply(folder / "sparse_pc.ply", content.cloud)
        meta["ply_file_path"] = "sparse_pc.ply"
    if content.split:
        for side in ("train", "test"):
            meta[f"{side}_filenames"] = [f"images/{name}" for name in content.split[side]]
        meta["val_filenames"] = meta["test_filenames"]
    _write_json(folder / "transforms.json", meta)


def write_openmvg(content: Content, folder: Path) -> None:
    """Write `sfm_data.json`, colorized.ply for the colours, and the lists."""
    views, extrinsics, sizes = _mvg_views(content)
    intrinsics = []
    for key, (width, height) in enumerate(sizes):
        # As cereal writes it: only the first object of a type has its name, and pointers are numbered throughout.
        kind = {"polymorphic_id": 1} if key else {"polymorphic_id": 2147483649, "polymorphic_name": "spherical"}
        data = {"value0": {"width": width, "height": height}}
        wrapper = {"id": 2147483650 + len(views) + key, "data": data}
        intrinsics.append({"key": key, "value": {**kind, "ptr_wrapper": wrapper}})
    cloud, tracks = content.cloud or Cloud(torch.zeros(0, 3), None), content.tracks or Tracks.from_observations([])
    structure = [{"key": k, "value": {"X": x, "observations": []}} for k, x in enumerate(cloud.points.tolist())]
    if cloud.colors is not None:
        write_ply(folder / "colorized.ply", cloud)
    rows = zip(tracks.frame.tolist(), tracks.point.tolist(), tracks.pixels.tolist(), strict=True)
    for feature, (frame, point, pixel) in enumerate(rows):
        seen = {"key": frame, "value": {"id_feat": feature, "x": pixel}}
        structure[point]["value"]["observations"].append(seen)
    data = {"sfm_data_version": "0.3", "root_path": "images", "views": views, "intrinsics": intrinsics}
    data |= {"extrinsics": extrinsics, "structure": structure, "control_points": []}
    _write_json(folder / "sfm_data.json", data)
    _write_lists(content, folder)


def write_opensfm(content: Content, folder: Path) -> None:
    """Write `reconstruction.json` with one reconstruction, and the lists."""
    from scipy.spatial.transform import Rotation

    cameras, shots = {}, {}
    for frame in content.frames:
        width, height = _size(frame)
        camera = f"panorama {width} {height} spherical"
        cameras[camera] = {"projection_type": "spherical", "width": width, "height": height}
        shots[frame.name] = {
            "rotation": Rotation.from_matrix(frame.cam_from_world[:3, :3].numpy()).as_rotvec().tolist(),
            "translation": frame.cam_from_world[:3, 3].tolist(),
            "camera": camera,
        }
    points = {}
    if content.cloud is not None:
        rows = zip(content.cloud.points.tolist(), _colors(content.cloud).tolist(), strict=True)
        points = {str(k): {"coordinates": point, "color": color} for k, (point, color) in enumerate(rows)}
    _write_json(folder / "reconstruction.json", [{"cameras": cameras, "shots": shots, "points": points}])
    _write_lists(content, folder)


def write_released(content: Content, folder: Path) -> None:
    """Write data_views.json, data_extrinsics.json, pcd.ply and the lists (without extensions)."""
    views, extrinsics, _ = _mvg_views(content)
    _write_json(folder / "data_views.json", {"views": views})
    _write_json(folder / "data_extrinsics.json", {"extrinsics": extrinsics})
    if content.cloud is not None:
        colors = torch.from_numpy(_colors(content.cloud))  # the released programs need some
        write_ply(folder / "pcd.ply", Cloud(content.cloud.points, colors))
    _write_lists(content, folder, extensions=False)


WRITERS: dict[str, Callable[[Content, Path], None]] = {
    "colmap": write_colmap,
    "transforms": write_transforms,
    "nerfstudio": write_transforms,
    "openmvg": write_openmvg,
    "opensfm": write_opensfm,
    "released": write_released,
}


def _mvg_views(content: Content) -> tuple[list[dict[str, Any]], list[dict[str, Any]], list[tuple[int, int]]]:
    """Return OpenMVG's views and extrinsics, and the sizes of the images, each once."""
    views, extrinsics, sizes = [], [], [*dict.fromkeys(map(_size, content.frames))]
    for i, frame in enumerate(content.frames):
        width, height = _size(frame)
        data = {"local_path": "", "filename": frame.name, "width": width, "height": height}
        data |= {"id_view": i, "id_intrinsic": sizes.index((width, height)), "id_pose": i}
        wrapper = {"id": 2147483650 + i, "data": data}
        views.append({"key": i, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": wrapper}})
        rotation, translation = frame.cam_from_world[:3, :3], frame.cam_from_world[:3, 3]
        center = -rotation.T @ translation
        extrinsics.append({"key": i, "value": {"rotation": rotation.tolist(), "center": center.tolist()}})
    return views, extrinsics, sizes


def _size(frame: Frame) -> tuple[int, int]:
    assert frame.width is not None and frame.height is not None
    return frame.width, frame.height


def _colors(cloud: Cloud) -> Any:
    colors = torch.full((len(cloud.points), 3), 128, dtype=torch.uint8) if cloud.colors is None else cloud.colors
    return colors.numpy()


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, ensure_ascii=False, allow_nan=False), encoding="utf-8")


def _write_lists(content: Content, folder: Path, extensions: bool = True) -> None:
    for side, names in content.split.items():
        lines = [name if extensions else view_name(name) for name in names]
        if broken := next((name for name in names if re.search(r"[\r\n]", name)), None):
            raise DataError(f"{broken!r} has a line break, and a list has one name a line; rename the image")
        (folder / LISTS[side]).write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
