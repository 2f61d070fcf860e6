"""Far Gaussians stand where no point does, and nowhere else."""

import math
from dataclasses import replace

import pytest
import torch
from tiny_scene import tiny_scene

from padgs.methods.plus.depth_initialization import COVERED_SPACINGS, FAR_FACTOR, far_gaussians, fibonacci_sphere
from padgs.methods.splats.splats import Splats
from padgs.scene import Scene

COUNT = 3000


def under(hemisphere: bool, scale: float = 1.0) -> Scene:
    """A dome of points at a distance of 4 around the cameras of the tiny scene; or the lower half of it (y is down)."""
    scene = tiny_scene()
    centre = torch.stack([view.center for view in scene.train]).median(0).values
    directions = fibonacci_sphere(20_000)
    if hemisphere:
        directions = directions[directions[:, 1] > 0]
    points = (centre + 4 * directions).float() * scale
    poses = []
    for view in scene.train:
        pose = view.cam_from_world.clone()
        pose[:3, 3] *= scale
        poses.append(replace(view, cam_from_world=pose))
    colors = torch.zeros(len(points), 3, dtype=torch.uint8)
    return replace(scene, train=tuple(poses), points=points, point_colors=colors)


def sky(scene: Scene) -> tuple[Splats, torch.Tensor]:
    """The far Gaussians, and where they are as seen from the middle of the cameras."""
    made = far_gaussians(scene, COUNT, degree=1, opacity=0.5)
    centre = torch.stack([view.center for view in scene.train]).median(0).values
    return made, made.means.detach().double() - centre


def test_directions_are_unit_and_even():
    directions = fibonacci_sphere(COUNT)
    assert torch.allclose(directions.norm(dim=-1), torch.ones(COUNT, dtype=torch.float64))
    assert directions.mean(0).abs().max() < 1e-3
    moments = directions.T @ directions / COUNT
    assert torch.allclose(moments, torch.eye(3, dtype=torch.float64) / 3, atol=1e-3)


def test_where_points_are_all_around_there_is_no_sky():
    assert len(sky(under(hemisphere=False))[0]) == 0


@pytest.mark.parametrize("points", [100, 500])
def test_a_sparse_cloud_all_around_leaves_no_hole(points):
    scene = under(hemisphere=False)
    few = torch.randperm(len(scene.points), generator=torch.Generator().manual_seed(0))[:points]
    assert len(sky(replace(scene, points=scene.points[few]))[0]) < 0.02 * COUNT


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_the_open_half_gets_it(scale):
    made, rays = sky(under(hemisphere=True, scale=scale))
    assert rays.norm(dim=-1) == pytest.approx([FAR_FACTOR * 4 * scale] * len(rays), rel=0.02)
    height = rays[:, 1] / rays.norm(dim=-1)
    margin = COVERED_SPACINGS * math.sqrt(4 * math.pi / COUNT)
    assert height.max() < -0.8 * margin and len(rays) == pytest.approx(COUNT * (1 - margin) / 2, rel=0.02)
    apart = torch.cdist(rays, rays).fill_diagonal_(math.inf).min(-1).values.median()
    assert made.log_scales.exp().median().item() == pytest.approx(apart.item() / 2, rel=0.3)  # they touch
