"""Published bounds: instances of the released OmniGS and OP43DGS."""

from __future__ import annotations

import math

import pytest
import torch
from support.native_tiles import NativeTiles
from support.render_cases import identity_pose, needs_native, projected

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Panorama
from padgs.render import RenderOptions
from padgs.render.projection import TILE

OMNIGS = RenderOptions("erp", near=0.2, wrap=False, bounds="square")
EXACT = RenderOptions("tangent", near=0.2)
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
