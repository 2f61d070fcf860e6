"""Bounds lose nothing: each (pixel, Gaussian) pair with alpha >= 1/255 is rendered; by brute force."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support import render_cases as cases
from support.definition import MARGIN, alphas, blended, near_a_decision
from support.native_tiles import pixel_boxes
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Camera, Panorama, Pinhole
from padgs.geometry.panorama import direction
from padgs.render import RenderOptions, render
from padgs.render.contract import ALPHA_MIN

KINDS_OF_SCENE = st.sampled_from(cases.KINDS)
SEEDS = st.integers(0, 2**31)
SIZES = st.sampled_from([*cases.ODD_SIZES, (64, 32), (1, 1), (16, 16), (17, 3), (3, 40)])
NEAR = st.sampled_from([0.0, 0.0, 0.02, 1.5])
few = settings(max_examples=5, deadline=None, derandomize=True, database=None)
more = settings(max_examples=10, deadline=None, derandomize=True, database=None)


def unsure(gaussians: Gaussians, camera: Camera, options: RenderOptions, alpha: Tensor) -> Tensor:
    """Return pairs [N, P] that rounding may decide: near the cut or the maximum, opposite the mean, or near `near`."""
    pairs = near_a_decision(alpha)
    if options.projection == "erp" and options.wrap:
        center = (torch.atan2(gaussians.means[:, 0], gaussians.means[:, 2]) / (2 * math.pi) + 0.5) * camera.width
        column = torch.arange(camera.width * camera.height) % camera.width
        across = (column + 0.5 - center[:, None] + camera.width / 2) % camera.width
        pairs |= torch.minimum(across, camera.width - across) < 1e-3
    if options.projection == "ray" and options.near > 0:
        factors = ((1 - MARGIN) * options.near, (1 + MARGIN) * options.near)
        closer, further = (alphas(gaussians, camera, RenderOptions("ray", near=near)) for near in factors)
        pairs |= (closer > 0) != (further > 0)
    return pairs


@cases.each_setup
@cases.each_engine
@few
@given(kind=KINDS_OF_SCENE, seed=SEEDS, size=SIZES, near=NEAR, wrap=st.booleans())
def test_no_contribution_is_lost(kind, seed, size, near, wrap, backend, dtype, projection: str, lens: str):
    gaussians = cases.gaussians_of(kind, 15, torch.Generator().manual_seed(seed))
    options, camera = (
        RenderOptions(projection, near=near, wrap=wrap or projection != "erp"),
        cases.camera_of(lens, *size),
    )
    alpha = alphas(gaussians, camera, options)
    expected = blended(gaussians, alpha)
    rendering = cases.draw(gaussians, *size, backend=backend, dtype=dtype, lens=lens, options=options)
    firm = ~unsure(gaussians, camera, options, alpha).any(0)
    tolerance = 1e-9 if dtype == torch.float64 else 2e-5
    assert ((rendering.image.reshape(-1, 3) - expected).abs().amax(-1)[firm] <= tolerance).all()
    must_be_visible = (alpha >= ALPHA_MIN * (1 + MARGIN)).any(1)
    assert rendering.visible[must_be_visible].all()


@cases.each_setup
@cases.needs_native
@more
@given(kind=KINDS_OF_SCENE, seed=SEEDS, size=SIZES, near=NEAR, wrap=st.booleans())
def test_each_gaussian_alone_covers_all_its_pixels(kind, seed, size, near, wrap, projection: str, lens: str):
    gaussians = cases.gaussians_of(kind, 12, torch.Generator().manual_seed(seed))
    options = RenderOptions(projection, near=near, wrap=wrap or projection != "erp")
    view = cases.view_of(cases.camera_of(lens, *size))
    alpha = alphas(gaussians, view.camera, options)
    perhaps = unsure(gaussians, view.camera, options, alpha)
    for index in range(len(gaussians)):
        alone = cases.chosen(gaussians, slice(index, index + 1)).to(torch.float32)
        covered = render(alone, view, options, backend="cpu").transmittance.flatten() < 1
        wrong = (covered != (alpha[index] >= ALPHA_MIN)) & ~perhaps[index]
        assert not wrong.any(), f"Gaussian {index}, pixels {wrong.nonzero()[:4, 0].tolist()}"


@pytest.mark.slow
@pytest.mark.parametrize("size", [(72, 36), (300, 100), (1000, 500)])
@pytest.mark.parametrize("kind", cases.KINDS)
@cases.each_setup
@cases.needs_native
def test_no_gaussian_of_many_loses_a_pixel(kind: str, size: tuple[int, int], projection: str, lens: str):
    test = test_each_gaussian_alone_covers_all_its_pixels.hypothesis.inner_test
    for seed in range(20 if size[0] < 100 else 2):
        test(kind, seed, size, 0.0, True, projection, lens)


CAMERAS_OF_ANY_SIZE = {
    "panorama": lambda width: Panorama(width, width // 2),
    "pinhole": lambda width: Pinhole(width, width // 2, 0.45 * width, 0.4 * width, 0.46 * width, 0.3 * width),
}


@pytest.mark.parametrize("width", [72, 1000, 4096, 16384])
@pytest.mark.parametrize("side", ["left", "right", "above", "below"])
@pytest.mark.parametrize(("projection", "lens"), [setup for setup in cases.SETUPS if "fisheye" not in setup])
@cases.needs_native
def test_the_outermost_pixel_of_a_footprint_is_drawn(side: str, width: int, projection: str, lens: str):
    """Round footprints centred on a row or column of pixels, and so opaque that alpha is 1.003/255 four pixels away."""
    generator = torch.Generator().manual_seed(width)
    camera, count = CAMERAS_OF_ANY_SIZE[lens](width), 60
    step = torch.tensor({"left": (-4, 0), "right": (4, 0), "above": (0, -4), "below": (0, 4)}[side])
    low = torch.tensor([0.1 * camera.width, 0.1 * camera.height])
    pixel = (low + 0.8 * torch.rand(count, 2, generator=generator) * torch.tensor([camera.width, camera.height])).long()
    center = pixel + 0.5 + 0.5 * (torch.rand(count, 1, generator=generator) - 0.5) * step.sign()
    center = center.double()
    if lens == "panorama":
        longitude, latitude = (center / torch.tensor([camera.width, camera.height]) - 0.5).unbind(-1)
        normal = direction(2 * math.pi * longitude, math.pi * latitude)
    else:
        normal = torch.nn.functional.pad((center - torch.tensor([camera.cx, camera.cy])), (0, 1), value=1.0)
        normal = torch.nn.functional.normalize(normal / torch.tensor([camera.fx, camera.fy, 1.0]), dim=-1)
    radius = 1 + 3 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    scale = 1.5 / camera.focal * radius
    quats, opacities = torch.randn(count, 4, generator=generator).double(), torch.full((count,), 0.5).double()
    round_ones = Gaussians(radius * normal, quats, scale.expand(count, 3), opacities, torch.ones(count, 3).double())
    options = RenderOptions(projection, low_pass=0.01)
    target = pixel + step
    there = alphas(round_ones, camera, options, target[:, 1] * camera.width + target[:, 0]).diagonal()
    opacities = opacities * (1.003 * ALPHA_MIN / there)
    inside = ((target >= 0) & (target < torch.tensor([camera.width, camera.height]))).all(1)
    usable = inside & (
        opacities < 0.95
    )  # toward the poles four pixels are no distance, at the rim of a pinhole image a long one
    assert usable.double().mean() > 0.5
    single = cases.chosen(Gaussians(round_ones.means, quats, round_ones.scales, opacities, round_ones.colors), usable)
    column, end, _, row, row_end = pixel_boxes(single, camera, options, cases.identity_pose()).unbind(1)
    u, v = target[usable].unbind(1)
    assert ((column <= u) & (u < end) & (row <= v) & (v < row_end)).all()


@cases.each_engine
def test_published_bounds_lose_contributions(backend: str, dtype: torch.dtype):
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
    alpha = alphas(broad.to(torch.float64), Panorama(width, height), RenderOptions(wrap=False))[0].view(height, width)
    sigma = width / (2 * math.pi) * scale
    rendering = cases.draw(broad, width, height, backend=backend, dtype=dtype, options=cases.RELEASED)
    lost = (rendering.transmittance == 1) & (alpha >= ALPHA_MIN * 1.001)
    assert lost.any() and alpha[lost].max() <= 0.0112 * 0.95
    column = torch.arange(width) + 0.5 - width / 2
    assert (column[lost.any(0) & ~lost.all(0)].abs() > 3 * sigma - 16).any()


@pytest.mark.parametrize("bounds", ["exact", "square"])
@cases.each_engine
def test_without_wrap_footprints_end_at_the_seam(bounds: str, backend: str, dtype: torch.dtype):
    gaussians = cases.gaussians_of("seam", 20, torch.Generator().manual_seed(3))
    left = gaussians.means[:, 0] < 0  # longitudes just above -180 degrees: the left border
    options = RenderOptions(wrap=False, bounds=bounds)
    for side, columns in ((left, slice(64, None)), (~left, slice(None, 64))):
        rendering = cases.draw(cases.chosen(gaussians, side), 128, 64, backend=backend, dtype=dtype, options=options)
        assert (rendering.transmittance < 1).any()
        assert (rendering.transmittance[:, columns] == 1).all()
