"""COLMAP models of generated scenes whose panoramas stand beside photographs of other cameras."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from padgs.data.synthetic import SyntheticOptions, SyntheticTruth, generate
from padgs.geometry.camera import Pinhole
from padgs.render.cubemap import FACES

CAMERAS = {"panorama": 1, "face": 2, "fisheye": 3}
FISHEYE = 200.0  # degrees across the circle whose diameter is the image's width


def fisheye_rays(size: int, focal: float) -> torch.Tensor:
    """Return directions [size, size, 3] of an equidistant fisheye: the angle from the axis is radius / focal."""
    offset = (torch.arange(size, dtype=torch.float64) + 0.5 - size / 2) / focal
    y, x = torch.meshgrid(offset, offset, indexing="ij")
    angle = torch.hypot(x, y)
    sinc = torch.sinc(angle / math.pi)
    return torch.stack((x * sinc, y * sinc, torch.cos(angle)), -1)


def write_mixed(folder: Path, options: SyntheticOptions, kinds: Mapping[int, Sequence[str]], samples: int = 2) -> None:
    """Write images and sparse/0; `kinds` says how each view along the path is photographed.

    panorama: as it is; face: six photographs of 90 degrees; fisheye: two back to back, of 141 degrees from edge to edge
    and `FISHEYE` from corner to corner. Their pixels are as wide as those of the panorama.
    """
    truth, scene = SyntheticTruth(options), generate(options)
    focal = options.width / (2 * math.pi)
    side, circle = round(2 * focal), round(focal * math.radians(FISHEYE) / math.sqrt(2))
    fine = Pinhole(samples * side, samples * side, samples * side / 2, samples * side / 2, *[samples * side / 2] * 2)
    tables = {
        "face": (FACES, fine.rays(dtype=torch.float64)),
        "fisheye": (FACES[[0, 2]], fisheye_rays(samples * circle, samples * focal)),
    }
    lines, views = [], {view.name: view for view in (*scene.train, *scene.test)}

    def add(name: str, kind: str, pixels: np.ndarray, pose: torch.Tensor) -> None:
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(folder / "images" / name)
        x, y, z, w = Rotation.from_matrix(pose[:3, :3].numpy()).as_quat()
        numbers = [w, x, y, z, *pose[:3, 3].tolist()]
        lines.append(f"{len(lines) + 1} {' '.join(map(str, numbers))} {CAMERAS[kind]} {name}\n\n")

    for index, of_view in kinds.items():
        view = views[truth.names[index]]
        for kind in of_view:
            if kind == "panorama":
                add(f"panorama/{view.name}.png", kind, view.load_pixels().numpy(), view.cam_from_world)
                continue
            turns, rays = tables[kind]
            for number, turn in enumerate(turns):
                pose = view.cam_from_world.clone()
                pose[:3] = turn @ pose[:3]
                directions = rays.reshape(-1, 3) @ pose[:3, :3]
                color = truth.world.color(view.center.float()[:, None].numpy(), directions.T.float().numpy())
                size = len(rays) // samples
                mean = color.reshape(3, size, samples, size, samples).mean((2, 4)).transpose(1, 2, 0)
                pixels = np.clip(mean * 255 + 0.5, 0, 255).astype(np.uint8)
                add(f"{kind}/{view.name}-{number}.png", kind, pixels, pose)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "images.txt").write_text("".join(lines))
    (model / "cameras.txt").write_text(
        f"1 EQUIRECTANGULAR {options.width} {options.height} {options.width} {options.height}\n"
        f"2 PINHOLE {side} {side} {side / 2} {side / 2} {side / 2} {side / 2}\n"
        f"3 OPENCV_FISHEYE {circle} {circle} {focal} {focal} {circle / 2} {circle / 2} 0 0 0 0\n"
    )
    points = zip(scene.points.tolist(), scene.point_colors.tolist(), strict=True)
    rows = (f"{number} {x} {y} {z} {r} {g} {b} 1\n" for number, ((x, y, z), (r, g, b)) in enumerate(points))
    (model / "points3D.txt").write_text("".join(rows))
