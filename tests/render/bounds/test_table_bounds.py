"""Bounds of ray tables that are nearly panoramas."""

import pytest
import torch
from support.render_cases import mixture, needs_native, random_pose, view_of

from padgs.geometry.camera import Panorama, RayTable
from padgs.geometry.lens import axis_direction, bend
from padgs.render import RenderOptions, render
from padgs.render.backends.native import native_camera

OPTIONS = RenderOptions("ray")


def bent(width: int, height: int, k1: float, axis: str = "z") -> RayTable:
    panorama = Panorama(width, height)
    rays = bend(panorama.rays(dtype=torch.float64), axis_direction(axis), torch.tensor([k1], dtype=torch.float64))
    return RayTable(rays.float(), panorama.focal)


@needs_native
@pytest.mark.parametrize("projection", ["ray", "tangent"])
@pytest.mark.parametrize("axis", "xz")
@pytest.mark.parametrize("k1", [-0.009, 0.009])
def test_bounds_around_a_bent_panorama_lose_nothing(k1, axis, projection):
    generator = torch.Generator().manual_seed(41)
    table = bent(160, 80, k1, axis)
    for _ in range(2):
        gaussians, view = mixture(6, generator).to(torch.float32), view_of(table, random_pose(generator))
        drawn = render(gaussians, view, RenderOptions(projection), backend="cpu")
        upside = RayTable(-table.table, table.focal)  # far off any panorama: without bounds
        flip = torch.eye(4, dtype=torch.float64)
        flip[:3, :3] *= -1  # a point reflection of world and rays changes nothing
        assert native_camera(flip, upside, OPTIONS).off_panorama < 0
        assert 0 <= native_camera(flip, table, OPTIONS).off_panorama < 0.3
        truth = render(gaussians.to(torch.float64), view, RenderOptions(projection), backend="torch")
        assert drawn.counters["contributing"] >= 0.998 * truth.counters["contributing"]
        assert ((drawn.image - truth.image).abs().amax(-1) > 1e-3).double().mean() < 0.002  # decisions at 1/255


@needs_native
def test_bounds_of_a_bent_panorama_are_tight():
    generator = torch.Generator().manual_seed(42)
    gaussians = mixture(40, generator).to(torch.float32)
    plain = render(gaussians, view_of(Panorama(256, 128)), OPTIONS, backend="cpu").counters
    table = render(gaussians, view_of(bent(256, 128, 0.003)), OPTIONS, backend="cpu").counters
    assert table["instances"] < 2 * plain["instances"]
