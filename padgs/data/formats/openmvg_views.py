"""The `views` and `extrinsics` of OpenMVG's JSON, which several formats share.

An extrinsic is the rotation cam from world (row by row) and the camera's centre in the world; camera axes are ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from padgs.data.errors import DataError
from padgs.data.formats.json_file import entries, entry, numbers
from padgs.data.formats.poses import cam_from_center
from padgs.data.splits import check_inside


@dataclass(frozen=True)
class MvgView:
    """One entry of `views`."""

    key: int
    pose: int  # id_pose
    name: str  # local_path and filename
    width: int
    height: int


def read_views(data: Any, file: Path) -> list[MvgView]:
    """The entries of `views`, in the file's order."""
    views = []
    for item in entries(data, "views", str(file)):
        where = f"a view of {file}"
        wrapper = entry(entry(item, "value", where), "ptr_wrapper", where)
        view = entry(wrapper, "data", where)
        name = str(entry(view, "filename", where))
        local = str(view.get("local_path", "")).strip("/")
        name = check_inside(f"{local}/{name}" if local else name, str(file))
        key = int(entry(item, "key", where))
        size = (int(entry(view, "width", where)), int(entry(view, "height", where)))
        views.append(MvgView(key, int(view.get("id_pose", key)), name, *size))
    return views


def read_extrinsics(data: Any, file: Path) -> dict[int, Tensor]:
    """Key of the pose -> cam_from_world [4, 4] float64."""
    poses = {}
    for item in entries(data, "extrinsics", str(file)):
        key = int(entry(item, "key", f"an extrinsic of {file}"))
        where = f"extrinsic {key} of {file}"
        value = entry(item, "value", where)
        rotation = numbers(entry(value, "rotation", where), (3, 3), f"rotation of {where}")
        center = numbers(entry(value, "center", where), (3,), f"center of {where}")
        poses[key] = cam_from_center(rotation, center, where)
    if not poses:
        raise DataError(f"{file} holds no extrinsics; export them too (openMVG_main_ConvertSfM_DataFormat -V -I -E -S)")
    return poses
