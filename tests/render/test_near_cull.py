"""near_cull=ellipsoid culls Gaussians that reach the near plane, and changes nothing else."""

import math
from dataclasses import replace

import pytest
import torch
from support.render_cases import each_engine, gaussians_of, identity_pose, projected

from padgs.gaussians import Gaussians, rotation_matrices
from padgs.geometry.camera import Panorama
from padgs.geometry.panorama import direction
from padgs.render import RenderOptions, render
from padgs.scene import View

VIEW = View("v", identity_pose(), 64, 32, lens=Panorama(64, 32))
NEAR = 0.1


def options(**more) -> RenderOptions:
    return RenderOptions(projection="ray", near=NEAR, low_pass=0.0, **more)


def balls(relative_size: float, spread: float, generator: torch.Generator, count: int = 4000) -> Gaussians:
    """Return opaque Gaussians around the camera, distances log-uniform in [0.1, 10], axes log-normal."""

    def uniform(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)

    radius = 10 ** uniform(-1, 1)
    axes = torch.exp(spread * torch.randn(count, 3, generator=generator, dtype=torch.float64))
    normal = direction(uniform(-math.pi, math.pi), torch.asin(uniform(-1, 1)))
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    scales = relative_size * radius[:, None] * axes
    return Gaussians(radius[:, None] * normal, quats, scales, radius.new_ones(count), normal.abs())


@each_engine
def test_round_gaussians_are_culled_by_their_nearest_point(backend, dtype):
    """Compare R - sqrt(2 ln 255) sigma with near, just below and above."""
    sigma = 0.3
    edge = NEAR + sigma * math.sqrt(2 * math.log(255))
    means = torch.tensor([[0, 0, edge - 1e-4], [edge + 1e-4, 0, 0], [0, edge - 1e-4, 0]], dtype=dtype)
    scales, quats = means.new_full((3, 3), sigma), means.new_tensor([[1.0, 0, 0, 0]]).repeat(3, 1)
    gaussians = Gaussians(means, quats, scales, means.new_ones(3), means.new_ones(3, 3))
    visible = render(gaussians, VIEW, options(near_cull="ellipsoid"), backend=backend).visible
    assert visible.tolist() == [False, True, False]


@each_engine
def test_rendered_ellipsoids_are_beyond_the_near_plane(backend, dtype, generator):
    """Points on the surface q = k lie beyond n.x = near for all visible Gaussians, but not for culled ones."""
    gaussians = balls(0.15, 0.7, generator, count=300)
    opacities = 0.05 + 0.9 * torch.rand(300, generator=generator, dtype=torch.float64)
    gaussians = replace(gaussians, opacities=opacities).to(dtype)
    drawn = render(gaussians, VIEW, options(near_cull="ellipsoid"), backend=backend).visible
    plain = render(gaussians, VIEW, options(), backend=backend).visible
    k = 2 * torch.log(255 * gaussians.opacities.double())
    sphere = torch.nn.functional.normalize(torch.randn(20_000, 3, generator=generator, dtype=torch.float64), dim=-1)
    spread = (rotation_matrices(gaussians.quats) * gaussians.scales[:, None]).double()
    normal = torch.nn.functional.normalize(gaussians.means.double(), dim=-1)
    reach = gaussians.means.double().norm(dim=-1) - torch.sqrt(k) * torch.stack(
        [(sphere @ axes.T @ n).max() for axes, n in zip(spread, normal, strict=True)]
    )  # a little too large, as no sample is exactly the nearest point
    assert (reach[drawn] > NEAR - 1e-5).all()
    culled = plain & ~drawn
    assert culled.sum() > 20 and drawn.sum() > 20
    size = gaussians.scales.double().amax(-1) * torch.sqrt(k)
    assert (reach[culled] < NEAR + 0.02 * size[culled]).all()


@pytest.mark.parametrize(("relative_size", "published"), [(0.02, 1.9), (0.1, 18), (0.3, 75), (0.5, 95)])
def test_culled_shares_match_reference_numbers(relative_size, published, generator):
    """Axes log-normal with deviation 0.7 and opacity 1, as we assume for the other program."""
    gaussians = balls(relative_size, 0.7, generator, count=20_000)
    kept = projected(gaussians, identity_pose(), VIEW.camera, options(near_cull="ellipsoid")).visible
    culled = 100 * (~kept).double().mean().item()
    assert culled == pytest.approx(published, abs=3 * math.sqrt(culled * (100 - culled) / 20_000) + 0.6)


@each_engine
def test_remaining_gaussians_are_unchanged(backend, dtype, generator):
    gaussians = gaussians_of("ordinary", 30, generator).to(dtype)
    plain, culled = (
        render(gaussians, VIEW, options(near_cull=kind), backend=backend) for kind in ("mean", "ellipsoid")
    )
    assert torch.equal(culled.visible, plain.visible) and torch.equal(culled.image, plain.image)
