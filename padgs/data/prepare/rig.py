"""Panoramas as rigs of twelve perspective views, for structure from motion with undistorted features.

Three rows of four 90-degree views at latitudes -35, 0 and 35 degrees. Every direction belongs to the view with the
nearest centre, so that no feature is found twice. The views have the panorama's resolution at its horizon.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from padgs.data.capture import Cloud, Frame, Progress, Tracks
from padgs.data.formats.colmap_lens import pycolmap_module
from padgs.data.formats.poses import rigid
from padgs.data.images import decode, save_png
from padgs.data.perspectives import looking_at
from padgs.geometry.camera import Pinhole
from padgs.geometry.panorama import direction, project, sample

LATITUDES = (-35.0, 0.0, 35.0)  # degrees, positive down
VIEWS_PER_ROW = 4


def cam_from_pano() -> Tensor:
    """Return rotations [12, 3, 3] from the panorama's frame to its views'; rows are right, down, forward."""
    # The middle row is rotated by half a view, which evens out the overlap.
    longitude = 90.0 * torch.arange(VIEWS_PER_ROW) + 45.0 * (torch.arange(len(LATITUDES)) % 2)[:, None]  # degrees
    latitude = torch.tensor(LATITUDES)[:, None].expand_as(longitude)
    return looking_at(direction(longitude.double().deg2rad(), latitude.double().deg2rad()).flatten(0, 1))


def view_lens(pano_width: int) -> Pinhole:
    """Return the pinhole camera of all views: 90 degrees, about W / pi pixels, even sides."""
    size = 2 * round(pano_width / math.pi / 2)
    return Pinhole(size, size, size / 2, size / 2, size / 2, size / 2)


def render_views(
    images: dict[str, Path], masks: dict[str, Path], folder: Path, mask_folder: Path, progress: Progress
) -> None:
    """Write the twelve views of every panorama, all of one size, as <view>/<name>.png.

    Masks are named as COLMAP requires, <view>/<name>.png.png; panoramas without a mask are used entirely.
    """
    rotations = cam_from_pano()
    for done, (name, path) in enumerate(sorted(images.items())):
        image = torch.from_numpy(decode(path))
        mask = torch.from_numpy(decode(masks[name], "L")) if name in masks else None
        rays = view_lens(image.shape[1]).rays(dtype=torch.float64)
        for index, rotation in enumerate(rotations):
            pano_rays = rays @ rotation  # R^T d: from the view's frame to the panorama's
            use = (pano_rays @ rotations[:, 2].mT).argmax(-1) == index  # each direction belongs to one view
            if mask is not None:
                use &= sample(mask, pano_rays)[..., 0].round() >= 128
            save_png(sample(image, pano_rays), folder / view_name(index, name), compress_level=1)
            save_png(use.byte() * 255, mask_folder / f"{view_name(index, name)}.png", compress_level=1)
        progress(done + 1, len(images))


def view_name(index: int, name: str) -> str:
    """Return the file of a view of the panorama `name`, relative to the folder of views."""
    return f"{index:02d}/{name}.png"


def rig_config() -> Any:
    """Return the rig for pycolmap: the first view is its reference, all share one centre."""
    pycolmap = pycolmap_module()
    rotations = cam_from_pano()
    cameras = []
    for index, rotation in enumerate(rotations):
        from_first = rigid(rotation @ rotations[0].mT, torch.zeros(3))[:3].numpy()
        place = None if index == 0 else pycolmap.Rigid3d(from_first)
        prefix = f"{index:02d}/"
        cameras.append(pycolmap.RigConfigCamera(ref_sensor=index == 0, image_prefix=prefix, cam_from_rig=place))
    return pycolmap.RigConfig(cameras=cameras)


def panoramas(model: Any, images: dict[str, Path], width: int) -> tuple[tuple[Frame, ...], Cloud, Tracks]:
    """Convert a pycolmap.Reconstruction of rig views to frames, points and observations of their panoramas."""
    rotations = cam_from_pano()
    points = dict(sorted(model.points3D.items()))
    row_of = {point_id: row for row, point_id in enumerate(points)}
    cloud = Cloud(
        torch.from_numpy(np.array([point.xyz for point in points.values()], np.float64)),
        torch.from_numpy(np.array([point.color for point in points.values()], np.uint8)),
    )
    poses: dict[str, Tensor] = {}
    seen: list[tuple[str, Tensor, Tensor]] = []  # name, rows of points, pixels; per view
    for image in model.images.values():
        if not image.has_pose:
            continue
        view, name = int(image.name[:2]), image.name[3:].removesuffix(".png")  # of `view_name`
        matrix = torch.from_numpy(np.array(image.cam_from_world().matrix()))
        poses.setdefault(name, rigid(rotations[view].mT @ matrix[:, :3], rotations[view].mT @ matrix[:, 3]))
        if with_point := [point for point in image.points2D if point.has_point3D()]:
            pixels = torch.from_numpy(np.array([point.xy for point in with_point]))
            half = view_lens(width).width / 2
            rays = torch.cat((pixels / half - 1, torch.ones(len(pixels), 1, dtype=torch.float64)), dim=1)
            rows = torch.tensor([row_of[point.point3D_id] for point in with_point])
            seen.append((name, rows, project(rays @ rotations[view], width, width // 2)))
    names = sorted(poses)
    seen.sort(key=lambda part: part[0])
    frames = tuple(Frame(name, images[name], poses[name], width, width // 2) for name in names)
    tracks = Tracks(
        frame=torch.cat([torch.full((len(rows),), names.index(name)) for name, rows, _ in seen]),
        point=torch.cat([rows for _, rows, _ in seen]),
        pixels=torch.cat([pixels for _, _, pixels in seen]),
    )
    return frames, cloud, tracks
