"""Published bounds (instances of the released OmniGS and OP43DGS), bounds of ray tables that are nearly panoramas."""

import math

import pytest
import torch
from support.native_tiles import NativeTiles
from support.render_cases import identity_pose, mixture, needs_native, projected, random_pose, view_of

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Panorama, RayTable
from padgs.geometry.lens import axis_direction, bend
from padgs.render import RenderOptions, render
from padgs.render.backends.native import native_camera
from padgs.render.projection import TILE

OMNIGS = RenderOptions("erp", near=0.2, wrap=False, bounds="square")
EXACT = RenderOptions("tangent", near=0.2)
RAY = RenderOptions("ray")
# Tiles of a Gaussian, on average, as another program measured them with the released code's formulas.
DISTANCES = (1, 3, 10, 30, 100)
PUBLISHED = (11, 34, 362, 1432, 3772)


def shell(distance: float, count: int = 2000, sigma: float = 0.1) -> Gaussians:
    """Return Gaussians in all directions, of many shapes, with the same angular sizes at every distance; degrees."""
    generator = torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    size = torch.exp(
        0.6 * torch.randn(count, 1, generator=generator) + 1.2 * torch.randn(count, 3, generator=generator)
    )
    return Gaussians(
        means=distance * normals,
        quats=torch.randn(count, 4, generator=generator),
        scales=distance * math.radians(sigma) * size,
        opacities=torch.full((count,), 0.5),
        colors=torch.full((count, 3), 0.5),
    )


def op43dgs(width: int, near: float = 0.2) -> RenderOptions:
    """Options of the released OP43DGS: 0.3 square pixels of 512 per radian."""
    low_pass = 0.3 * (width / (2 * math.pi) / 512) ** 2
    return RenderOptions("tangent", near=near, wrap=False, bounds="square", low_pass=low_pass)


def tiles_each(distance: float, options: RenderOptions, width: int) -> float:
    """Return the mean number of tiles of a Gaussian, by the definition."""
    gaussians, camera = shell(distance), Panorama(width, width // 2)
    footprints = projected(gaussians, torch.eye(4), camera, options)
    assert footprints.boxes is not None
    boxes = footprints.boxes[footprints.visible]
    ends = -(-boxes.new_tensor([width, width, width // 2, width // 2]) // TILE)
    tiles = torch.minimum((boxes / TILE).clamp(min=0), ends)
    return ((tiles[:, 1] - tiles[:, 0]) * (tiles[:, 3] - tiles[:, 2])).sum().item() / len(gaussians)


def test_only_extents_of_the_released_op43dgs_grow_with_distance():
    grown = [tiles_each(distance, op43dgs(2048), 2048) for distance in DISTANCES]
    for mean, published in zip(grown, PUBLISHED, strict=True):
        assert published / 1.5 < mean < published * 1.5  # of Gaussians that are not the same; measured: within 1.35
    for distance in DISTANCES:
        assert tiles_each(distance, OMNIGS, 2048) == pytest.approx(tiles_each(1, OMNIGS, 2048), rel=0.01)


@needs_native
def test_exact_extents_do_not_grow():
    camera = Panorama(2048, 1024)
    counts = [NativeTiles(shell(distance), camera, EXACT, identity_pose()).count for distance in DISTANCES]
    assert max(counts) <= 1.01 * min(counts)
    assert max(counts) < 0.6 * 2000 * tiles_each(1, OMNIGS, 2048)


@needs_native
@pytest.mark.parametrize("options", [OMNIGS, op43dgs(512)], ids=["omnigs", "op43dgs"])
@pytest.mark.parametrize("distance", [1, 10, 100])
def test_native_tiles_match_the_definition(options: RenderOptions, distance: float):
    count = NativeTiles(shell(distance), Panorama(512, 256), options, identity_pose()).count
    assert count == pytest.approx(2000 * tiles_each(distance, options, 512), rel=1e-3)  # ceil and floor in float32


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_extents_of_the_released_op43dgs_depend_on_the_unit(scale: float):
    at_home = tiles_each(10, op43dgs(512), 512)
    grown = tiles_each(10 * scale, op43dgs(512, near=0.0), 512)
    assert grown > 4 * at_home if scale > 1 else grown < at_home / 4


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
        assert native_camera(flip, upside, RAY).off_panorama < 0
        assert 0 <= native_camera(flip, table, RAY).off_panorama < 0.3
        truth = render(gaussians.to(torch.float64), view, RenderOptions(projection), backend="torch")
        assert drawn.counters["contributing"] >= 0.998 * truth.counters["contributing"]
        assert ((drawn.image - truth.image).abs().amax(-1) > 1e-3).double().mean() < 0.002  # decisions at 1/255


@needs_native
def test_bounds_of_a_bent_panorama_are_tight():
    generator = torch.Generator().manual_seed(42)
    gaussians = mixture(40, generator).to(torch.float32)
    plain = render(gaussians, view_of(Panorama(256, 128)), RAY, backend="cpu").counters
    table = render(gaussians, view_of(bent(256, 128, 0.003)), RAY, backend="cpu").counters
    assert table["instances"] < 2 * plain["instances"]
