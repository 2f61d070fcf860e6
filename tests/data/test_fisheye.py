"""Two circles side by side are told from panoramas, dark and cut ones included."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from fixtures import World, write_colmap_text
from PIL import Image

from padgs.data import DataError
from padgs.data.check import check
from padgs.data.images import is_dual_fisheye
from padgs.data.prepare.sources import find_source
from padgs.geometry.panorama import sample

SIZE = 96
FIELD = math.radians(190)  # of each lens


def dual_fisheye(panorama: np.ndarray, *, noise: int = 6, radius: float = 1.0) -> np.ndarray:
    """What two equidistant fisheye lenses, one forward and one backward, see of a panorama; [SIZE, 2 SIZE, 3] uint8."""
    step = (torch.arange(SIZE) + 0.5) / SIZE * 2 - 1
    down, right = torch.meshgrid(step, step, indexing="ij")
    distance = torch.hypot(right, down) / radius
    angle = distance * FIELD / 2
    across = angle.sin() / distance / radius
    rays = torch.stack((right * across, down * across, angle.cos()), dim=-1)
    halves = [rays, rays * torch.tensor([-1.0, 1.0, -1.0])]
    image = torch.from_numpy(panorama).float() / 255
    seen = torch.cat([sample(image, half) * (distance <= 1)[..., None] for half in halves], dim=1)
    random = np.random.default_rng(0).integers(0, noise, (SIZE, 2 * SIZE, 1))
    return (seen.numpy() * 255 + random).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("radius", [0.94, 1.0, 1.04])
def test_two_circles_are_seen(radius: float, world: World) -> None:
    assert is_dual_fisheye(dual_fisheye(world.images[0], radius=radius))


def test_panoramas_are_none(world: World) -> None:
    night = (world.images[0] * 0.05).astype(np.uint8)
    capped = world.images[0].copy()
    capped[:8] = capped[-8:] = 0  # what a stitcher leaves where no lens looked
    one = dual_fisheye(world.images[0])
    one[:, SIZE:] = world.images[0][0, 0]
    for image in (*world.images, night, capped, np.zeros_like(night), one):
        assert not is_dual_fisheye(image)


def test_prepare_and_check_say_what_to_do(world: World, tmp_path: Path) -> None:
    for name in world.names:
        Image.fromarray(dual_fisheye(world.images[0])).save(tmp_path / f"{name}.jpg", quality=80)
    with pytest.raises(DataError, match=r"pano_00.jpg shows two circles side by side.* Stitch it with the program"):
        find_source(tmp_path, "auto")
    write_colmap_text(world, tmp_path / "posed")
    (tmp_path / "pano_02.jpg").rename(tmp_path / "posed/images/pano_02.png")
    assert any("pano_02.png shows two circles" in problem for problem in check(tmp_path / "posed").problems)
