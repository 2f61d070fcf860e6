"""Bounds lose nothing: each (pixel, Gaussian) pair with alpha >= 1/255 is drawn. By brute force from the definition."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from render_cases import INPUTS, KINDS, ODD_SIZES, draw, each_engine, gaussians_of, identity_pose, mixture, needs_native
from torch import Tensor

from padgs.camera import Camera, Panorama
from padgs.gaussians import Gaussians, rotation_matrices
from padgs.render import RELEASED, RenderOptions, native
from padgs.render.contract import ALPHA_MIN
from padgs.render.native_camera import native_camera
from padgs.render.tiles import TILE, Projected

KINDS_OF_SCENE = st.sampled_from(KINDS)
SEEDS = st.integers(0, 2**31)
SIZES = st.sampled_from([*ODD_SIZES, (64, 32), (1, 1), (16, 16), (17, 3)])
few = settings(max_examples=12, deadline=None, derandomize=True, database=None)


def erp_alphas(gaussians: Gaussians, width: int, height: int, options: RenderOptions) -> Tensor:
    """Alpha [N, H, W] of every Gaussian at every pixel by the definition (golden README), without bounds or the cut."""
    x, y, z = gaussians.means.unbind(-1)
    rho, r = torch.hypot(x, z), gaussians.means.norm(dim=-1)
    zero, c = torch.zeros_like(x), (rho / r).clamp(min=1e-4)
    east = torch.stack((z, zero, -x), dim=-1) / rho[:, None]
    down = torch.stack((-x * y, rho * rho, -y * z), dim=-1) / (rho * r)[:, None]
    row_u = width / (2 * math.pi) * east / (r * c)[:, None]
    row_v = height / math.pi * down / r[:, None]
    jacobian = torch.stack((row_u, row_v), dim=1)
    spread = rotation_matrices(gaussians.quats) * gaussians.scales[:, None, :]
    half = jacobian @ spread
    covariance = half @ half.transpose(1, 2) + options.low_pass * torch.eye(2, dtype=x.dtype)
    inverse = torch.linalg.inv(covariance)
    center_u = (torch.atan2(x, z) / (2 * math.pi) + 0.5) * width
    center_v = (torch.atan2(y, rho) / math.pi + 0.5) * height
    du = torch.arange(width, dtype=x.dtype) + 0.5 - center_u[:, None]
    if options.wrap:
        du = (du + width / 2) % width - width / 2
    dv = torch.arange(height, dtype=x.dtype) + 0.5 - center_v[:, None]
    a, b, d = (inverse[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    du, dv = du[:, None, :], dv[:, :, None]
    q = a * du * du + 2 * b * du * dv + d * dv * dv
    alpha = gaussians.opacities[:, None, None] * torch.exp(-0.5 * q)
    return torch.where((r > options.near)[:, None, None], alpha, torch.zeros_like(alpha))


def blended(gaussians: Gaussians, alphas: Tensor) -> Tensor:
    """The image [H, W, 3] over black of all alphas [N, H, W], one Gaussian after the other."""
    image = torch.zeros(*alphas.shape[1:], 3, dtype=alphas.dtype)
    left = torch.ones_like(alphas[0])
    alive = torch.ones_like(left, dtype=torch.bool)
    for index in torch.argsort(gaussians.means.norm(dim=-1), stable=True).tolist():
        alpha = torch.where(alphas[index] >= ALPHA_MIN, alphas[index].clamp(max=0.99), torch.zeros_like(left))
        alive &= left * (1 - alpha) >= 1e-4
        weight = torch.where(alive, left * alpha, torch.zeros_like(left))
        image += weight[..., None] * gaussians.colors[index]
        left = left - weight
    return image


def near_a_decision(alphas: Tensor, margin: float = 1e-3) -> Tensor:
    """Pixels [H, W] where rounding may decide whether a pair counts."""
    return (((alphas / ALPHA_MIN - 1).abs() < margin) | ((alphas / 0.99 - 1).abs() < margin)).any(0)


@each_engine
@few
@given(kind=KINDS_OF_SCENE, seed=SEEDS, size=SIZES, wrap=st.booleans())
def test_no_contribution_is_lost(
    kind: str, seed: int, size: tuple[int, int], wrap: bool, backend: str, dtype: torch.dtype
):
    gaussians = gaussians_of(kind, 15, torch.Generator().manual_seed(seed))
    options = RenderOptions(wrap=wrap)
    alphas = erp_alphas(gaussians, *size, options)
    expected = blended(gaussians, alphas)
    rendering = draw(gaussians, *size, backend=backend, dtype=dtype, options=options)
    firm = ~near_a_decision(alphas)
    if wrap:  # exactly opposite a mean, rounding decides on which side of it a pixel lies
        centers = (torch.atan2(gaussians.means[:, 0], gaussians.means[:, 2]) / (2 * math.pi) + 0.5) * size[0]
        across = (torch.arange(size[0]) + 0.5 - centers[:, None] + size[0] / 2) % size[0]
        firm &= ~(torch.minimum(across, size[0] - across) < 1e-3).any(0)
    tolerance = 1e-9 if dtype == torch.float64 else 2e-5
    assert ((rendering.image - expected).abs().amax(-1)[firm] <= tolerance).all()
    must_be_visible = (alphas >= ALPHA_MIN * (1 + 1e-3)).flatten(1).any(1)
    assert rendering.visible[must_be_visible].all()


@each_engine
@few
@given(kind=KINDS_OF_SCENE, seed=SEEDS, size=SIZES, wrap=st.booleans())
def test_each_gaussian_alone_covers_all_its_pixels(
    kind: str, seed: int, size: tuple[int, int], wrap: bool, backend: str, dtype: torch.dtype
):
    gaussians = gaussians_of(kind, 12, torch.Generator().manual_seed(seed))
    options = RenderOptions(wrap=wrap)
    alphas = erp_alphas(gaussians, *size, options)
    for index in range(len(gaussians)):
        alone = Gaussians(**{name: tensor[index : index + 1] for name, tensor in vars(gaussians).items()})
        contributing = draw(alone, *size, backend=backend, dtype=dtype, options=options).counters["contributing"]
        surely = int((alphas[index] >= ALPHA_MIN * (1 + 1e-3)).sum())
        perhaps = int((alphas[index] >= ALPHA_MIN * (1 - 1e-3)).sum())
        assert surely <= contributing <= perhaps, index


class NativeTiles:
    """The tile lists of one view, drawn in one strip, as tensors."""

    def __init__(self, gaussians: Gaussians, camera: Camera, options: RenderOptions) -> None:
        inputs = [getattr(gaussians, name).float().contiguous() for name in INPUTS]
        structure = native.Inputs(len(gaussians), *map(native.pointer, inputs), None)
        self.projected = Projected(native_camera(identity_pose(), camera, options), structure, 1 << 40)
        (strip,) = self.projected.strips()
        self.strip, self.count = strip, len(strip.instances)
        self.gaussian, self.slot, packed = strip.instances.unbind(1)
        self.row, self.row_end, self.chunk, self.chunk_end = (packed >> shift & 255 for shift in (0, 8, 16, 24))
        self.tile = torch.repeat_interleave(torch.arange(strip.tiles), strip.tile_start.diff())
        level = self.projected.level.long()
        chunks = -(-camera.width // TILE)
        per_row = -(-chunks // (1 << level))
        self.row_of_tile = torch.repeat_interleave(torch.arange(len(level)), per_row)
        column_of_tile = torch.arange(strip.tiles) - (per_row.cumsum(0) - per_row)[self.row_of_tile]
        self.first_column = column_of_tile * TILE << level[self.row_of_tile]  # [tiles] pixels
        self.columns = TILE << level[self.row_of_tile]

    def listed(self, gaussian: int, width: int, height: int) -> Tensor:
        """How many instances of a Gaussian hold each pixel, [H, W]."""
        times = torch.zeros(height, width, dtype=torch.int64)
        for i in (self.gaussian == gaussian).nonzero()[:, 0].tolist():
            x, y = int(self.first_column[self.tile[i]]), int(self.row_of_tile[self.tile[i]]) * TILE
            rows = slice(y + int(self.row[i]), y + int(self.row_end[i]))
            times[rows, x + TILE * int(self.chunk[i]) : x + TILE * int(self.chunk_end[i])] += 1
        return times


@needs_native
@few
@given(kind=KINDS_OF_SCENE, seed=SEEDS, size=st.sampled_from([*ODD_SIZES, (200, 90), (256, 128)]), wrap=st.booleans())
def test_native_tiles_hold_every_pixel_and_each_tile_once(kind: str, seed: int, size: tuple[int, int], wrap: bool):
    width, height = size
    gaussians = gaussians_of(kind, 25, torch.Generator().manual_seed(seed))
    options = RenderOptions(wrap=wrap)
    tiles = NativeTiles(gaussians, Panorama(width, height), options)
    accepted = erp_alphas(gaussians, width, height, options) >= ALPHA_MIN * (1 + 1e-3)
    for index in range(len(gaussians)):
        assert (tiles.listed(index, width, height)[accepted[index]] == 1).all()
    both = torch.stack((tiles.gaussian.long(), tiles.tile), dim=1)
    assert len(both.unique(dim=0)) == tiles.count, "a Gaussian is twice in the same tile"
    radius = gaussians.means.float().norm(dim=-1)[tiles.gaussian.long()]
    same_tile = tiles.tile.diff() == 0
    assert (radius.diff()[same_tile] >= -1e-6 * radius[:-1][same_tile]).all(), "not front to back"
    # Slots: consecutive for each Gaussian, each used once.
    assert torch.equal(tiles.slot.long().sort().values, torch.arange(tiles.count))
    owner = torch.repeat_interleave(torch.arange(len(gaussians)), tiles.strip.slot_start.diff())
    assert torch.equal(owner[tiles.slot.long()], tiles.gaussian.long())


@needs_native
def test_native_tiles_are_few():
    """Bounds follow the opacity and both axes, and tiles are wider near the poles: far fewer than published."""
    gaussians = mixture(200, torch.Generator().manual_seed(5), ("ordinary", "polar"))
    ours = NativeTiles(gaussians, Panorama(512, 256), RenderOptions(wrap=False)).count
    published = NativeTiles(gaussians, Panorama(512, 256), RELEASED).count
    assert ours < 0.5 * published


@each_engine
def test_published_bounds_lose_what_they_lose(backend: str, dtype: torch.dtype):
    """A square of three standard deviations cuts alphas up to 0.011 o, and a footprint ends at the seam."""
    scale = 0.25
    broad = Gaussians(
        means=torch.tensor([[0.0, 0.0, 1.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.full((1, 3), scale),
        opacities=torch.tensor([0.95]),
        colors=torch.ones(1, 3),
    )
    width, height = 256, 128
    alphas = erp_alphas(broad.to(torch.float64), width, height, RenderOptions(wrap=False))[0]
    sigma = width / (2 * math.pi) * scale
    rendering = draw(broad, width, height, backend=backend, dtype=dtype, options=RELEASED)
    lost = (rendering.transmittance == 1) & (alphas >= ALPHA_MIN * 1.001)
    assert lost.any() and alphas[lost].max() <= 0.0112 * 0.95
    column = torch.arange(width) + 0.5 - width / 2
    assert (column[lost.any(0) & ~lost.all(0)].abs() > 3 * sigma - 16).any()


@pytest.mark.parametrize("bounds", ["exact", "square"])
@each_engine
def test_without_wrap_footprints_end_at_the_seam(bounds: str, backend: str, dtype: torch.dtype):
    gaussians = gaussians_of("seam", 20, torch.Generator().manual_seed(3))
    left = gaussians.means[:, 0] < 0  # longitudes just above -180 degrees: the left border
    options = RenderOptions(wrap=False, bounds=bounds)
    for side, columns in ((left, slice(64, None)), (~left, slice(None, 64))):
        some = Gaussians(**{name: tensor[side] for name, tensor in vars(gaussians).items()})
        rendering = draw(some, 128, 64, backend=backend, dtype=dtype, options=options)
        assert (rendering.transmittance < 1).any()
        assert (rendering.transmittance[:, columns] == 1).all()
