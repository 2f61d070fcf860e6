"""Equivalent descriptions of a camera: formula, ray table, or another pose."""

from dataclasses import replace

import pytest
import torch
from support import render_cases as cases

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Camera, Panorama, Pinhole, RayTable, perspective
from padgs.render import RenderOptions, render
from padgs.render.backends.native import native_rays

each_free = pytest.mark.parametrize("projection", ("tangent", "ray"))  # free of charts: any camera will do


def picture(
    gaussians: Gaussians, camera: Camera, projection: str, *, backend, dtype, pose=None, weight=None, **options
):
    """Return the image, and the gradients of its sum times `weight` [H, W, 3] by every input."""
    inputs, view = cases.leaves(gaussians, dtype), cases.view_of(camera, pose)
    rendering = render(inputs, view, RenderOptions(projection, **options), backend=backend)
    if weight is None:
        return rendering.image
    return rendering.image, torch.autograd.grad((rendering.image * weight).sum(), list(vars(inputs).values()))


@pytest.mark.parametrize("size", [(72, 36), (70, 44), (33, 17)])
@pytest.mark.parametrize("lens", ["panorama", "pinhole"])
@each_free
@cases.each_engine
def test_panorama_equals_its_ray_table(size, lens: str, projection: str, backend: str, dtype: torch.dtype):
    generator = torch.Generator().manual_seed(31)
    gaussians, options = cases.mixture(5, generator), RenderOptions(projection, near=0.02)
    formula = cases.camera_of(lens, *size)
    stable = cases.stable_pixels(gaussians, *size, lens=lens, options=options)
    assert stable.double().mean() > 0.85
    weight = torch.randn(*stable.shape, 3, generator=generator, dtype=torch.float64) * stable[..., None]
    engine = {"backend": backend, "dtype": dtype, "weight": weight.to(dtype), "near": 0.02}
    expected, expected_gradients = picture(gaussians, formula, projection, **engine)
    table = RayTable(formula.rays(dtype=dtype), formula.focal)
    actual, gradients = picture(gaussians, table, projection, **engine)
    tolerance = 1e-9 if dtype == torch.float64 else 2e-5
    assert (actual - expected)[stable].abs().max() <= tolerance
    for name, gradient, truth in zip(cases.INPUTS, gradients, expected_gradients, strict=True):
        assert cases.row_error(gradient, truth) < (1e-8 if dtype == torch.float64 else 2e-3), name


@each_free
@cases.each_engine
def test_turning_the_camera_turns_its_rays(projection: str, backend: str, dtype: torch.dtype):
    """The panorama of a rotated camera equals the image of the original camera along the rotated rays."""
    generator = torch.Generator().manual_seed(32)
    gaussians = cases.mixture(4, generator)
    for _ in range(30 if backend == "cpu" else 5):
        pose = cases.random_pose(generator)
        panorama = Panorama(70, 35)
        stable = cases.stable_pixels(gaussians, 70, 35, pose=pose, options=RenderOptions(projection))
        turned = picture(gaussians, panorama, projection, backend=backend, dtype=dtype, pose=pose)
        rays = panorama.rays(dtype=torch.float64) @ pose[:3, :3]  # d_world = R^T d_camera
        table = RayTable(torch.nn.functional.normalize(rays, dim=-1).to(dtype), panorama.focal)
        expected = picture(gaussians, table, projection, backend=backend, dtype=dtype)
        limit = 1e-6 if dtype == torch.float64 else 5e-5  # R itself is orthonormal to float32 only
        assert (turned - expected)[stable].abs().max() <= limit


@cases.each_engine
def test_on_the_axis_the_perspective_jacobian_is_the_tangent_plane(backend: str, dtype: torch.dtype):
    """pinhole and tangent agree for means on the optical axis, and differ elsewhere."""
    generator = torch.Generator().manual_seed(34)
    camera = Pinhole(64, 48, 60.0, 60.0, 30.0, 22.0)
    for off_axis in (False, True):
        gaussians = cases.gaussians_of("ordinary", 1, generator)
        means = torch.tensor([[1.2 if off_axis else 0.0, 0.0, 3.0]], dtype=torch.float64)
        quats, scales = gaussians.quats, torch.tensor([[0.5, 0.2, 0.3]], dtype=torch.float64)
        one = Gaussians(means, quats, scales, gaussians.opacities.clamp(min=0.5), gaussians.colors)
        images = [
            picture(one, camera, projection, backend=backend, dtype=dtype) for projection in ("pinhole", "tangent")
        ]
        difference = (images[0] - images[1]).abs().max()
        assert (difference > 0.01) if off_axis else (difference < (1e-9 if dtype == torch.float64 else 1e-5))


@cases.each_engine
def test_tangent_is_the_limit_of_ray_for_small_gaussians(backend: str, dtype: torch.dtype):
    """tangent is the limit of ray; halving the angle halves the difference."""
    differences = []
    for size in (0.08, 0.04, 0.02):
        generator = torch.Generator().manual_seed(35)
        gaussians = cases.gaussians_of("ordinary", 20, generator)
        radius = gaussians.means.norm(dim=-1, keepdim=True)
        shape = size * torch.tensor([1.0, 0.5, 0.8], dtype=torch.float64)
        small = Gaussians(**{**vars(gaussians), "scales": radius * shape, "opacities": gaussians.opacities.clamp(0.5)})
        camera = Panorama(256, 128)
        images = [picture(small, camera, p, backend=backend, dtype=dtype, low_pass=0.0) for p in ("ray", "tangent")]
        differences.append((images[0] - images[1]).abs().amax().item())
    assert differences[0] > 0.005
    for larger, smaller in zip(differences, differences[1:], strict=False):
        assert 1.6 < larger / smaller < 2.6


@each_free
@cases.each_engine
def test_the_gradient_of_the_rays_is_that_of_the_pose(projection: str, backend: str, dtype: torch.dtype):
    """Rotating all rays by a small angle is rotating the camera; both derivatives must agree."""
    generator = torch.Generator().manual_seed(36)
    gaussians = cases.joined(cases.gaussians_of("ordinary", 15, generator), cases.gaussians_of("needle", 5, generator))
    table = cases.camera_of("fisheye", 60, 40).table.to(dtype).requires_grad_()
    pose = cases.random_pose(generator).to(dtype).requires_grad_()
    camera = RayTable(table, 25.0)
    weight = torch.randn(40, 60, 3, generator=generator, dtype=torch.float64).to(dtype)
    rendering = render(gaussians.to(dtype), cases.view_of(camera, pose), RenderOptions(projection), backend=backend)
    by_table, by_pose = torch.autograd.grad((rendering.image * weight).sum(), (table, pose))
    generators = torch.linalg.cross(torch.eye(3)[:, None].expand(3, 3, 3), torch.eye(3).expand(3, 3, 3)).to(dtype)
    for axis in range(3):
        turn = generators[axis].T  # d/dangle of the rotation about the axis
        rays_turn = (by_table * (table @ turn.T)).sum()
        camera_turn = (by_pose[:3, :3] * (turn.T @ pose[:3, :3])).sum()
        assert rays_turn.abs() > 0.1
        torch.testing.assert_close(rays_turn, camera_turn, rtol=1e-6 if dtype == torch.float64 else 1e-3, atol=1e-3)
    along = (by_table * table).sum(-1)  # the length of a ray means nothing
    assert along.abs().max() <= 1e-4 * by_table.norm(dim=-1).max()


def test_ray_tables_are_cached_until_they_change():
    table = Panorama(20, 10).rays()
    camera = RayTable(table, 20 / 6)
    first = native_rays(camera).table
    assert native_rays(camera).table is first and native_rays(RayTable(table, 5.0)).table is first
    table.neg_()
    second = native_rays(camera).table
    assert first is not None and second is not None and torch.equal(second, -first)
    assert native_rays(camera, torch.device("meta")).table.device.type == "meta"


@each_free
@pytest.mark.parametrize("backend", ["torch", "cpu"])
def test_what_a_photograph_cannot_show_is_not_visible(projection: str, backend: str):
    means = torch.tensor([[0.0, 0, 4], [4, 0, 0], [0, -4, 0], [0, 0, -4]])  # ahead, right, above and behind
    same = (
        cases.mixture(4, torch.Generator().manual_seed(34)).to(torch.float32).chosen(torch.zeros(4, dtype=torch.long))
    )
    gaussians = replace(same, means=means, scales=torch.full((4, 3), 0.05), opacities=torch.full((4,), 0.5))
    shown = render(gaussians, cases.view_of(perspective(32, 24, 60.0)), RenderOptions(projection), backend=backend)
    assert shown.visible.tolist() == [True, False, False, False] and shown.counters["visible"] == 1
