"""Gains of views are found from points that several show, whatever hides some of them, and told."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from fixtures import World, write_colmap_text

from padgs.cli.check import lines
from padgs.data.check import check
from padgs.data.conventions import exposure_gains

STOPS = np.array([0.0, -0.5, 0.3, -0.2, 0.0, 0.1])


def exposed(world: World) -> World:
    images = (image / 2 * 2.0**stop for image, stop in zip(world.images, STOPS, strict=True))
    return replace(world, images=tuple(image.round().astype(np.uint8) for image in images))


def test_gains_are_found_although_points_are_hidden(world: World) -> None:
    poses = torch.stack([torch.from_numpy(np.linalg.inv(world.world_from_cam(i))) for i in range(6)])
    images = torch.stack([torch.from_numpy(image) for image in exposed(world).images])
    images[2, :, :20] = images[2, :, 20:40]  # something stands before what the others show
    gains = exposure_gains(poses, images, torch.from_numpy(world.points))
    assert np.abs(gains.numpy() - (STOPS - np.median(STOPS))).max() < 0.05


def test_check_warns_of_uneven_exposures(world: World, tmp_path: Path) -> None:
    write_colmap_text(exposed(world), tmp_path)
    report = check(tmp_path)
    assert any("(pano_02); train with train.exposures=learned" in note for note in report.notes), report.notes
    assert report.problems == [] and any("exposures      differ by a factor of 1." in line for line in lines(report))
