"""The smoothness prior of padgs_plus."""

import math
from dataclasses import replace

import pytest
import torch

from padgs.geometry.camera import Panorama, Pinhole, perspective
from padgs.methods.plus import smoothness
from padgs.methods.plus.smoothness import MAX_BEND, fits_native, roughness
from padgs.native import cpu
from padgs.render import Rendering

needs_native = pytest.mark.skipif(not cpu.available(), reason="the native library is not built")


def shown(depth: torch.Tensor, image: torch.Tensor | None = None) -> Rendering:
    """A drawing with these distances, opaque, and grey if no colours are given."""
    image = torch.full((*depth.shape, 3), 0.5, dtype=depth.dtype) if image is None else image
    return Rendering(image, torch.zeros_like(depth), depth, torch.ones(1, dtype=torch.bool))


def rough(depth: torch.Tensor, image: torch.Tensor | None = None) -> float:
    return roughness(shown(depth, image), Panorama(depth.shape[1], depth.shape[0]), near=1e-6).item()


def wavy(width: int, normal: tuple[float, float, float]) -> torch.Tensor:
    """Distances [H, W] float64 around whose inverse is 1 + n . d, smooth at the poles and where the ends meet."""
    return 1 / (1 + Panorama(width, width // 2).rays(dtype=torch.float64) @ torch.tensor(normal, dtype=torch.float64))


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.2, -0.1, 0.5), (0.3, 0.0, 0.8)])
def test_roughness_of_a_plane_is_quadratic_in_the_pixel_size(normal):
    found = []
    for size in (32, 64):
        camera = perspective(size, size, 80.0)
        depth = 3 / (camera.rays(dtype=torch.float64) @ torch.tensor(normal, dtype=torch.float64)).abs()
        found.append(roughness(shown(depth), camera, near=1e-6).item())
    assert found[1] == pytest.approx(found[0] / 4, rel=0.1)


@pytest.mark.parametrize("normal", [(0.6, 0.0, 0.0), (0.0, 0.6, 0.0), (0.3, -0.4, 0.3)])
def test_roughness_at_poles_and_seam_vanishes_with_resolution(normal):
    coarse, fine = rough(wavy(64, normal)), rough(wavy(128, normal))
    assert fine == pytest.approx(coarse / 4, rel=0.1)
    noise = 1 + 0.02 * torch.randn(64, 128, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert rough(wavy(128, normal) * noise) > 20 * fine


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_lies_far_away_counts_less(dtype):
    """Beyond `far` the opacity counts far / r, and the weight is the product of three opacities."""
    noise = 1 + 1e-3 * torch.rand(8, 16, dtype=dtype, generator=torch.Generator().manual_seed(0))
    drawn, camera = shown(noise), Panorama(16, 8)
    all_of_it = roughness(drawn, camera, near=1e-6).item()
    assert all_of_it > 0 and roughness(drawn, camera, near=1e-6, far=1.1).item() == pytest.approx(all_of_it)
    assert roughness(drawn, camera, near=1e-6, far=0.5).item() == pytest.approx(all_of_it / 8, rel=0.01)


def test_roughness_is_invariant_to_units_and_heading():
    depth = wavy(64, (0.2, 0.1, 0.3)) * (1 + 0.05 * torch.rand(32, 64, dtype=torch.float64))
    assert rough(depth * 1e4) == pytest.approx(rough(depth)) and rough(depth.roll(13, 1)) == pytest.approx(rough(depth))


@pytest.mark.parametrize("height", [1, 2])
def test_images_too_small_for_second_differences_are_smooth(height):
    assert rough(1 + torch.rand(height, 2 * height)) == 0


def test_edges_in_the_image_lower_the_weight():
    depth = torch.ones(16, 32, dtype=torch.float64)
    depth[:, 16:] = 1.05
    image = torch.zeros(16, 32, 3, dtype=torch.float64)
    image[:, 16:] = 1.0
    assert 0 < rough(depth, image) < 1e-3 * rough(depth)


def test_large_jumps_have_no_gradient():
    depth = torch.ones(16, 32, dtype=torch.float64)
    depth[:, 16:] = 1 + 4 * MAX_BEND
    depth.requires_grad_()
    roughness(shown(depth), Panorama(32, 16), near=1e-6).backward()
    assert depth.grad is not None and not depth.grad.any()


def test_transparent_pixels_have_no_weight_and_perspective_rows_do_not_wrap():
    depth = torch.ones(16, 32, dtype=torch.float64)
    depth[:, :16] = 1.05  # the two jumps are in the middle, and where the ends meet
    clear = shown(depth)
    empty = replace(clear, transmittance=torch.ones_like(depth))
    assert roughness(empty, Panorama(32, 16), near=1e-6) == 0
    open_ended = roughness(clear, perspective(32, 16, 90.0), near=1e-6).item()
    assert 0 < open_ended < 0.6 * rough(depth)


def test_gradients():
    random = torch.Generator().manual_seed(3)
    depth = 1 + 0.01 * torch.rand(6, 12, dtype=torch.float64, generator=random)  # no bend as large as a jump
    image = torch.rand(6, 12, 3, dtype=torch.float64, generator=random)
    inputs = (depth.requires_grad_(),)
    assert torch.autograd.gradcheck(lambda d: roughness(shown(d, image), Panorama(12, 6), near=1e-6), inputs)
    assert not torch.isnan(torch.autograd.grad(roughness(shown(depth), Panorama(12, 6), near=1e-6), depth)[0]).any()


def noisy(camera: Panorama | Pinhole) -> Rendering:
    """A drawing with distances nearer than 0.5, transparent places, and edges of both kinds."""
    random = torch.Generator().manual_seed(camera.width)
    depth = 1 + 0.1 * torch.rand(camera.height, camera.width, generator=random)
    depth[camera.height // 2, camera.width // 2 :] *= 0.01
    depth[0, 0] = 0.5
    transmittance = (torch.rand(depth.shape, generator=random) - 0.3).clamp(min=0)
    transmittance[:, 1] = 1.0
    return Rendering(0.3 * torch.rand(*depth.shape, 3, generator=random), transmittance, depth, torch.ones(1).bool())


@needs_native
@pytest.mark.parametrize(
    "camera",  # sizes that fill no vector; the second finds what the first has left in its workspace
    [Panorama(33, 17), perspective(33, 17, 70.0), Panorama(32, 3), perspective(3, 3, 70.0), perspective(47, 21, 70.0)],
)
def test_native_matches_the_definition(camera, monkeypatch):
    taken, fits = [], smoothness.fits_native
    monkeypatch.setattr(smoothness, "fits_native", lambda drawn: fits(drawn) and not taken.append(1))
    found, drawn = {}, noisy(camera)
    for dtype in (torch.float32, torch.float64):  # the native pass takes float32 only
        for near in (0.5, 1e-3):
            leaf = drawn.depth.to(dtype, copy=True).requires_grad_()
            parts = {"image": drawn.image.to(dtype), "transmittance": drawn.transmittance.to(dtype), "depth": leaf}
            value = 3 * roughness(replace(drawn, **parts), camera, near=near)
            found[near, dtype] = value.item(), torch.autograd.grad(value, leaf)[0].double()
    assert len(taken) == 2
    for near in (0.5, 1e-3):
        (value, gradient), (defined, derivative) = found[near, torch.float32], found[near, torch.float64]
        assert value == pytest.approx(defined, rel=1e-5, abs=1e-9)
        assert (gradient - derivative).abs().max() <= 1e-4 * derivative.abs().max()


@needs_native
@pytest.mark.parametrize("part", ["depth", "transmittance", "image"])
@pytest.mark.parametrize("place", [(4, 5), (4, 1)])  # opaque, transparent
def test_nan_reaches_the_loss(part, place):
    camera = Panorama(33, 17)
    drawn = noisy(camera)
    getattr(drawn, part)[place] = math.nan
    assert math.isnan(roughness(drawn, camera, near=1e-3).item())


@needs_native
def test_unsupported_tensors_use_the_definition():
    camera = Panorama(16, 8)
    drawn = noisy(camera)
    assert fits_native(drawn) and not fits_native(replace(drawn, image=drawn.image.double()))
    assert not fits_native(replace(drawn, image=drawn.image[:4])) and not fits_native(
        replace(drawn, depth=drawn.depth[:2])
    )
    strided = replace(drawn, depth=drawn.depth.T.contiguous().T)
    assert roughness(strided, camera, near=1e-3) == roughness(drawn, camera, near=1e-3)
