"""Tile lists hold every pixel once, in order of depth, wide tiles near the poles; strips change nothing."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support import render_cases as cases
from support.definition import MARGIN, alphas
from support.native_tiles import NativeTiles, projected

from padgs.geometry.camera import Panorama
from padgs.render import RenderOptions
from padgs.render.backends.native import TILE
from padgs.render.contract import ALPHA_MIN

few = settings(max_examples=10, deadline=None, derandomize=True, database=None)
SIZES = st.sampled_from([*cases.ODD_SIZES, (200, 90), (256, 128), (1, 1), (90, 200)])


@cases.each_setup
@cases.needs_native
@few
@given(kind=st.sampled_from(cases.KINDS), seed=st.integers(0, 2**31), size=SIZES, wrap=st.booleans())
def test_tiles_contain_every_pixel_once(kind, seed, size, wrap, projection: str, lens: str):
    gaussians = cases.gaussians_of(kind, 12, torch.Generator().manual_seed(seed))
    camera, options = cases.camera_of(lens, *size), RenderOptions(projection, wrap=wrap or projection != "erp")
    tiles = NativeTiles(gaussians, camera, options, cases.identity_pose())
    accepted = alphas(gaussians, camera, options) >= ALPHA_MIN * (1 + MARGIN)
    for index in range(len(gaussians)):
        times = tiles.times_listed(index, camera)
        assert (times[accepted[index]] == 1).all() and times.max() <= 1
    pairs = torch.stack((tiles.gaussian, tiles.tile), dim=1)
    assert len(pairs.unique(dim=0)) == tiles.count, "a Gaussian is twice in the same tile"
    radius = gaussians.means.float().norm(dim=-1)[tiles.gaussian]
    same_tile = tiles.tile.diff() == 0
    assert (radius.diff()[same_tile] >= -1e-6 * radius[:-1][same_tile]).all(), "not front to back"
    # Slots: consecutive for each Gaussian, each used once.
    assert torch.equal(tiles.slot.sort().values, torch.arange(tiles.count))
    owner = torch.repeat_interleave(torch.arange(len(gaussians)), tiles.strip.slot_start.diff())
    assert torch.equal(owner[tiles.slot], tiles.gaussian)


@cases.needs_native
@pytest.mark.parametrize(("width", "height"), [(2048, 1024), (1000, 500), (72, 36), (300, 600), (16, 400)])
def test_tiles_cover_the_same_angle_in_every_row(width: int, height: int):
    gaussians = cases.gaussians_of("ordinary", 1, torch.Generator().manual_seed(1))
    level = projected(gaussians, Panorama(width, height), RenderOptions("ray"), cases.identity_pose()).level
    for row, found in enumerate(level.tolist()):
        latitude = ((row + 0.5) * TILE / height - 0.5) * math.pi
        wanted = round(math.log2(1 / max(math.cos(latitude), 1e-3)))
        assert 0 <= found <= 4 and (found == min(wanted, 4) or (TILE << found + 1) > -(-width // TILE) * TILE)
    for projection, lens in (("pinhole", "pinhole"), ("ray", "pinhole"), ("ray", "fisheye")):
        camera = cases.camera_of(lens, width, height)
        assert not projected(gaussians, camera, RenderOptions(projection), cases.identity_pose()).level.any()


@cases.needs_native
def test_exact_bounds_need_fewer_tiles():
    """Bounds depend on opacity and both axes, and tiles widen towards the poles."""
    gaussians = cases.mixture(200, torch.Generator().manual_seed(5), ("ordinary", "polar"))
    published = NativeTiles(gaussians, Panorama(512, 256), cases.RELEASED, cases.identity_pose()).count
    for projection in ("erp", "tangent", "ray"):
        ours = NativeTiles(gaussians, Panorama(512, 256), RenderOptions(projection), cases.identity_pose())
        assert ours.count < 0.45 * published


@cases.needs_native
def test_tile_count_of_a_small_gaussian_by_latitude():
    """It spans many columns near the poles; wide tiles keep the count below twice that of the horizon."""
    counts = []
    for latitude in (0, 45, 70, 80, 85):
        generator = torch.Generator().manual_seed(3)
        gaussians = cases.gaussians_of("ordinary", 300, generator)
        angle = math.radians(latitude) * torch.ones(300, dtype=torch.float64)
        longitude = 2 * math.pi * torch.rand(300, generator=generator, dtype=torch.float64)
        flat = torch.cos(angle)
        means = torch.stack((flat * torch.sin(longitude), torch.sin(angle), flat * torch.cos(longitude)), dim=-1)
        scales = torch.full((300, 3), math.radians(0.7))  # four pixels at this size
        moved = type(gaussians)(means, gaussians.quats, scales, gaussians.opacities, gaussians.colors)
        tiles = NativeTiles(moved, Panorama(2048, 1024), RenderOptions("ray"), cases.identity_pose())
        counts.append(tiles.count / 300)
    assert max(counts) < 2 * counts[0] and counts[0] < 7, counts


@pytest.mark.parametrize(
    ("projection", "lens", "more"),
    [
        *((*setup, {}) for setup in cases.SETUPS),
        ("erp", "panorama", {"wrap": False}),
        ("ray", "panorama", {"blending": "hybrid", "core_size": 4}),
    ],
)
@cases.needs_native
def test_strips_render_and_differentiate_the_same(projection: str, lens: str, more: dict):
    generator = torch.Generator().manual_seed(12)
    gaussians = cases.mixture(20, generator, ("ordinary", "polar", "seam", "needle"))
    engine = {"pose": cases.random_pose(generator, shift=0.1), "backend": "cpu", "dtype": torch.float32}
    weights, camera = torch.randn(90, 200, 5, generator=generator), cases.camera_of(lens, 200, 90)
    (whole, gradients), *others = (
        cases.differentiated(
            gaussians, camera, RenderOptions(projection, max_instances=limit, **more), weights, **engine
        )
        for limit in (1 << 26, 200, 1)
    )
    assert whole.counters["instances"] > 250
    for rendering, strip_gradients in others:
        assert rendering.counters == whole.counters
        for name in cases.OUTPUTS:
            assert torch.equal(getattr(rendering, name), getattr(whole, name)), name
        for name, gradient in gradients.items():
            if name == "rays":  # strips add to it one after the other
                torch.testing.assert_close(strip_gradients[name], gradient, rtol=1e-4, atol=1e-5)
            else:
                assert torch.equal(strip_gradients[name], gradient), name


@cases.needs_native
def test_strips_respect_max_instances():
    gaussians = cases.mixture(100, torch.Generator().manual_seed(13), ("ordinary", "polar"))
    for limit in (1, 100, 400, 1000):
        lists = projected(
            gaussians, Panorama(256, 128), RenderOptions("ray", max_instances=limit), cases.identity_pose()
        )
        strips = list(lists.strips())
        assert sum(len(strip.instances) for strip in strips) == lists.instances > 1000
        assert [strip.grid.first_row for strip in strips] == [0, *(strip.grid.end_row for strip in strips[:-1])]
        assert strips[-1].grid.end_row == len(lists.per_row)
        for strip in strips:
            assert len(strip.instances) <= limit or strip.grid.end_row == strip.grid.first_row + 1
