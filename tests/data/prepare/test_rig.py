"""Rigs of perspective views: rotations, ownership of directions, pixels and files."""

import numpy as np
import pytest
import torch
from PIL import Image

from padgs.data.prepare import rig
from padgs.geometry.panorama import direction, project, rays, sample


def test_rig_views_are_rotations_and_every_direction_belongs_to_one():
    rotations = rig.cam_from_pano()
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3, dtype=torch.float64).expand(12, 3, 3))
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(12, dtype=torch.float64))
    # The first view of the upper row looks ahead and 35 degrees up (-y); its right is the panorama's right.
    ahead_up = direction(torch.tensor(0.0), torch.tensor(-35.0).deg2rad()).double()
    torch.testing.assert_close(rotations[0] @ ahead_up, torch.tensor([0.0, 0.0, 1.0]).double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(rotations[0, 0], torch.tensor([1.0, 0.0, 0.0]).double())
    assert (rotations[:, 1, 1] > 0).all()  # no view hangs upside down
    every = rays(256, 128, dtype=torch.float64)
    owners = torch.stack([(every @ rotations[:, 2].mT).argmax(-1) == index for index in range(12)])
    x, y, z = (every @ rotations[:, None].mT).unbind(-1)
    seen = (owners & (z > 0) & (x.abs() <= z) & (y.abs() <= z)).any(0)
    latitude = (torch.arange(128) + 0.5) / 128 * 180 - 90
    assert seen[latitude.abs() < 70].all()


def test_rig_views_resample_the_panorama_at_the_resolution_of_its_horizon():
    """Compare with a smooth function of the direction, seam and poles included."""

    def color(directions):
        unit = directions / directions.norm(dim=-1, keepdim=True)
        return ((unit + 1) * 100).round().to(torch.uint8)

    image = color(rays(512, 256, dtype=torch.float64))
    for rotation in rig.cam_from_pano():
        pano_rays = rig.view_lens(512).rays(dtype=torch.float64) @ rotation
        difference = (sample(image, pano_rays).round().int() - color(pano_rays).int()).abs()
        assert difference.max() <= 2
    lens = rig.view_lens(2048)
    assert lens.width == lens.height == 652
    center = lens.rays(dtype=torch.float64)[326, 325:327]
    pixels = project(center, 2048, 1024)
    assert (pixels[1, 0] - pixels[0, 0]).item() == pytest.approx(1.0, abs=0.01)


def test_files_and_masks_of_views(tmp_path):
    image = np.full((32, 64, 3), 90, np.uint8)
    mask = np.full((32, 64), 255, np.uint8)
    mask[:16] = 0  # only what is below the horizon
    Image.fromarray(image).save(tmp_path / "a.png")
    Image.fromarray(mask).save(tmp_path / "mask.png")
    calls, used = [], {}
    paths = {"a.png": tmp_path / "a.png"}, {"a.png": tmp_path / "mask.png"}, tmp_path / "views", tmp_path / "masks"
    rig.render_views(*paths, lambda *step: calls.append(step))
    assert calls == [(1, 1)]
    for index in range(12):
        name = rig.view_name(index, "a.png")
        assert np.asarray(Image.open(tmp_path / "views" / name)).shape == (20, 20, 3)
        used[index] = (np.asarray(Image.open(tmp_path / "masks" / f"{name}.png")) > 0).mean()
    assert max(used[index] for index in range(4)) == 0  # the upper row lies above the horizon
    assert min(used[index] for index in range(8, 12)) > 0.3
