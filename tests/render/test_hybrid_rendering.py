"""Hybrid blending: its weights, and values, derivatives and order in every backend and projection."""

import functools
import math
from dataclasses import replace

import pytest
import torch
from support import render_cases
from support import render_cases as cases
from support.definition import one_pixel
from torch import Tensor

from padgs.gaussians import Gaussians, rotation_matrices
from padgs.geometry.camera import Camera, Panorama, Pinhole, RayTable
from padgs.geometry.panorama import direction
from padgs.render import RenderOptions, render
from padgs.render.backends.torch import hybrid_weights
from padgs.render.projection import PlanarFootprints
from padgs.scene import View

PROJECTIONS = ("erp", "pinhole", "tangent", "ray")
BACKGROUND = torch.tensor([0.3, 0.6, 0.9], dtype=torch.float64)
each_projection = pytest.mark.parametrize("projection", PROJECTIONS)


STEEP = {"tangent": {"steepness": 0.2}, "ray": {"steepness": 0.2}}


def camera_of(projection: str, width: int, height: int) -> Camera:
    if projection == "pinhole":
        return Pinhole(width, height, 0.4 * width, 0.4 * width, 0.5 * width + 1, 0.5 * height - 2)
    return Panorama(width, height)


def options_of(projection: str, size: int, **more) -> RenderOptions:
    return RenderOptions(projection=projection, blending="hybrid", core_size=size, **more)


def fragments(gaussians: Gaussians, camera: Camera, options: RenderOptions, pose: Tensor) -> tuple[Tensor, ...]:
    """Return alpha and distance [P, N], radial depths [N], and which pixels [P] are far from any decision."""
    footprints = cases.projected(gaussians, pose, camera, options)
    everything, pixels = torch.arange(len(gaussians)), torch.arange(camera.height * camera.width)
    rows, columns = pixels // camera.width, pixels % camera.width
    q, inside = footprints.squared_distance(everything, rows, columns)
    alpha = (footprints.opacities * torch.exp(-0.5 * q)).clamp(max=0.99)
    alpha = torch.where(inside & footprints.visible, alpha, 0.0).detach()
    means = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    radius = means.norm(dim=-1)
    if options.projection == "ray":  # t = (mu P d) / (d P d) with P = Sigma'^-1
        axes = pose[:3, :3] @ rotation_matrices(gaussians.quats)
        variance = gaussians.scales**2 + (options.low_pass / camera.focal**2 * radius**2)[:, None]
        precision = axes @ torch.diag_embed(1 / variance) @ axes.mT
        rays = camera.rays(dtype=torch.float64).view(-1, 3)
        quadratic = torch.einsum("pi,nij,pj->pn", rays, precision, rays)
        distance = torch.einsum("ni,nij,pj->pn", means, precision, rays) / quadratic
    else:
        distance = radius.expand_as(alpha)
    close = sum(((alpha / limit - 1).abs() < 1e-3).any(-1) for limit in (1 / 255, 0.05, 0.99))
    if isinstance(footprints, PlanarFootprints) and footprints.turn < math.inf:
        across = (columns[:, None] + 0.5 - footprints.centers[:, 0] + camera.width / 2) % camera.width
        opposite = torch.minimum(across, camera.width - across) < 1e-3
        close = close + (opposite & (alpha >= 0.5 / 255)).any(-1)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    in_order = torch.where(alpha >= 0.05, distance, torch.inf).sort(-1)[0]
    close = close + (in_order[:, 1:] - in_order[:, :-1] < 1e-4 * in_order[:, 1:]).any(-1)
    return alpha, distance.detach(), radius.detach(), close == 0


@pytest.mark.parametrize("size", [1, 4, 16])
@each_projection
@cases.each_engine
def test_images_match_the_published_procedure(projection: str, size: int, backend: str, dtype: torch.dtype):
    generator = torch.Generator().manual_seed(100 * PROJECTIONS.index(projection) + size)
    camera, options, pose = (
        camera_of(projection, 33, 17),
        options_of(projection, size),
        cases.random_pose(generator, 0.2),
    )
    gaussians = cases.mixture(6, generator)
    alpha, distance, radius, stable = fragments(gaussians, camera, options, pose)
    assert stable.double().mean() > 0.8
    view = View("v", pose, 33, 17, lens=camera)
    rendering = render(gaussians.to(dtype), view, options, background=BACKGROUND.to(dtype), backend=backend)
    contributing, sizes = 0, set()
    for pixel in stable.nonzero()[:, 0].tolist():
        row, column = pixel // 33, pixel % 33
        order = torch.randperm(len(radius), generator=generator)  # the procedure takes fragments as they come
        found, left = one_pixel(alpha[pixel, order].tolist(), distance[pixel, order].tolist(), size)
        weights = torch.zeros_like(radius).scatter(0, order, torch.tensor(found, dtype=torch.float64))
        color = weights @ gaussians.colors + left * BACKGROUND
        assert (rendering.image[row, column] - color).abs().max() < 2e-5
        assert abs(rendering.transmittance[row, column] - left) < 2e-5
        depth = (weights @ radius / weights.sum()).item() if weights.any() else 0.0
        assert rendering.depth[row, column].item() == pytest.approx(depth, rel=1e-4)
        contributing += int((weights > 0).sum())
        sizes.add(int((alpha[pixel] >= 0.05).sum()))
    assert max(sizes) > 4, "no pixel has an eviction to test"
    assert abs(rendering.counters["contributing"] - contributing) <= int((alpha[~stable] > 0).sum())


def defined(gaussians: Gaussians, camera: Camera, options: RenderOptions, generator: torch.Generator) -> tuple:
    """Return Gaussians, camera, options, stable pixels and the definition of a case."""
    *_, stable = fragments(gaussians, camera, options, cases.identity_pose())
    stable = stable.view(camera.height, camera.width)
    assert stable.double().mean() > 0.6
    arguments = (gaussians, camera, options, stable)
    return *arguments, cases.definition(*arguments, generator)


@functools.cache  # for all engines
def cases_of(projection: str, kind: str, size: int) -> list[tuple]:
    """Return what `defined` returns for two image sizes."""
    generator = torch.Generator().manual_seed(7 + size)
    gaussians = cases.gaussians_of("huge" if kind == "broad" else kind, 25, generator)
    gaussians.opacities[0] = 1.0  # reaches the maximum alpha, where the derivative is 0
    if kind == "broad":  # but with the camera outside, and seen through
        gaussians = replace(gaussians, scales=0.0625 * gaussians.scales, opacities=0.5 * gaussians.opacities)
    options = options_of(projection, size, **STEEP.get(projection, {}))
    cameras = [camera_of(projection, width, height) for width, height in ((70, 44), (33, 17))]
    return [defined(gaussians, camera, options, generator) for camera in cameras]


@cases.each_native_engine
@pytest.mark.parametrize("size", [1, 16, 256])
@pytest.mark.parametrize(
    ("projection", "kind"),
    [
        *[(p, kind) for p in ("erp", "tangent", "ray") for kind in ("ordinary", "polar", "pole", "seam", "broad")],
        *[("pinhole", kind) for kind in ("ordinary", "broad")],
    ],
)
def test_native_matches_the_definition(projection: str, kind: str, size: int, backend: str):
    for case in cases_of(projection, kind, size):
        cases.assert_matches_definition(*case, backend=backend, depth_tolerance=1e-4)


@cases.each_native_engine
@pytest.mark.parametrize("projection", ["tangent", "ray"])
@pytest.mark.parametrize("case", ["table", "pinhole", "fisheye", "wide tiles"])
def test_native_matches_the_definition_for_other_cameras(projection: str, case: str, backend: str, generator):
    if case == "table":
        formula = Panorama(45, 23)
        camera = RayTable(formula.rays(dtype=torch.float64), formula.focal)
        gaussians = cases.mixture(6, generator, ("ordinary", "polar", "seam"))
    elif case == "wide tiles":  # tiles near the poles of 330 columns are wider than a chunk
        camera, gaussians = Panorama(330, 165), cases.mixture(8, generator, ("polar", "pole", "seam"))
    else:
        camera, gaussians = render_cases.camera_of(case, 72, 36), cases.gaussians_of("ordinary", 60, generator)
    case = defined(gaussians, camera, options_of(projection, 3), generator)
    cases.assert_matches_definition(*case, backend=backend, depth_tolerance=1e-4)


def overlapping(count: int, generator: torch.Generator) -> Gaussians:
    """Return broad, flat Gaussians ahead at similar distances; the camera is outside of all."""

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    return replace(
        cases.gaussians_of("ordinary", count, generator),
        means=direction(uniform(-0.3, 0.3, count), uniform(-0.2, 0.2, count)) * uniform(2, 2.2, count, 1),
        scales=uniform(0.2, 0.56, count, 3),
        opacities=uniform(0.3, 0.6, count),
    )


@each_projection
@cases.each_engine
def test_a_large_core_is_exact_blending_in_the_order_of_the_rays(projection: str, backend: str, dtype: torch.dtype):
    generator = torch.Generator().manual_seed(11)
    camera, options = camera_of(projection, 128, 64), options_of(projection, 64)
    gaussians = overlapping(10, generator).to(torch.float32).to(torch.float64)
    alpha, distance, radius, stable = fragments(gaussians, camera, options, cases.identity_pose())
    drawn, faint = alpha > 0, (alpha > 0) & (alpha < 0.05)
    furthest = torch.where(drawn, distance, -1.0).argmax(-1, keepdim=True)
    stable &= drawn.any(-1)
    stable &= (faint.sum(-1) == 0) | ((faint.sum(-1) == 1) & faint.gather(1, furthest)[:, 0])  # then no order is lost
    assert stable.sum() > 100 and drawn[stable].sum(-1).max() > 5

    order = torch.argsort(distance, dim=-1)
    in_order = alpha.gather(1, order)
    left = torch.cumprod(torch.cat((torch.ones(len(alpha), 1), 1 - in_order), dim=-1), dim=-1)
    expected = torch.einsum("pk,pkc->pc", in_order * left[:, :-1], gaussians.colors[order])
    view = View("v", cases.identity_pose(), 128, 64, lens=camera)
    rendering = render(gaussians.to(dtype), view, options, backend=backend)
    assert (rendering.image.view(-1, 3) - expected)[stable].abs().max() < 2e-5
    assert (rendering.transmittance.view(-1) - left[:, -1])[stable].abs().max() < 2e-5

    # Where rays and means agree on the order, which only `ray` may not, this is the sorted blending too.
    along = torch.where(drawn, distance, torch.nan)[:, torch.argsort(radius)]
    agree = stable & torch.stack([pixel[~pixel.isnan()].diff().ge(0).all() for pixel in along])
    assert agree.sum() > 30 and (agree.equal(stable) or projection == "ray")
    assert projection != "ray" or agree.sum() < 0.9 * stable.sum()
    classic = render(gaussians.to(dtype), view, RenderOptions(projection), backend=backend)
    agree = agree.view(64, 128)
    for name in ("image", "transmittance", "depth"):
        torch.testing.assert_close(getattr(rendering, name)[agree], getattr(classic, name)[agree], rtol=1e-4, atol=1e-5)


@cases.each_engine
def test_each_ray_has_its_own_order(backend: str, dtype: torch.dtype):
    """Two long Gaussians cross ahead, turned by 45 degrees to either side: each is in front on one side."""
    half_turn = math.pi / 8
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0, 2], [0, 0, 2.001]]),
        quats=torch.tensor([[math.cos(half_turn), 0, sign * math.sin(half_turn), 0] for sign in (1, -1)]),
        scales=torch.tensor([[1.0, 0.1, 0.05]] * 2),
        opacities=torch.tensor([0.9, 0.9]),
        colors=torch.eye(3)[:2],
    ).to(dtype)
    view = View("v", cases.identity_pose(), 64, 9, lens=Pinhole(64, 9, 80.0, 80.0, 32.0, 4.5))
    hybrid, classic = (
        render(gaussians, view, RenderOptions(projection="ray", blending=blending), backend=backend).image[4]
        for blending in ("hybrid", "sorted")
    )
    first_leads = hybrid[:, 0] > hybrid[:, 1]  # a turn about y, which is down, brings the +x end of the first nearer
    assert first_leads[36:54].all() and not first_leads[10:28].any()
    assert (classic[10:54, 0] > classic[10:54, 1]).all()


@each_projection
@cases.each_engine
def test_input_order_does_not_matter(projection: str, backend: str, dtype: torch.dtype):
    generator = torch.Generator().manual_seed(12)
    gaussians, camera, options = cases.mixture(8, generator), camera_of(projection, 48, 24), options_of(projection, 3)
    *_, stable = fragments(gaussians, camera, options, cases.identity_pose())
    weights = torch.randn(24, 48, 5, generator=generator, dtype=torch.float64) * stable.view(24, 48, 1)
    order = torch.randperm(len(gaussians), generator=generator)
    permuted = Gaussians(**{name: getattr(gaussians, name)[order] for name in cases.INPUTS})
    first, gradients = cases.differentiated(gaussians, camera, options, weights, backend=backend, dtype=dtype)
    second, found = cases.differentiated(permuted, camera, options, weights, backend=backend, dtype=dtype)
    assert first.counters == second.counters
    torch.testing.assert_close(second.image, first.image, rtol=0, atol=1e-6)
    for name in cases.INPUTS:
        assert cases.row_error(found[name], gradients[name][order]) < 1e-4, name


def random_fragments(pixels: int, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return alpha and distance [P, K]: a third not drawn, a third faint."""
    alpha = torch.rand(pixels, count, generator=generator, dtype=torch.float64)
    kind = torch.randint(3, alpha.shape, generator=generator)
    alpha = torch.where(kind == 0, 0.0, torch.where(kind == 1, 1 / 255 + 0.04 * alpha, 0.06 + 0.6 * alpha))
    return alpha, 1 + torch.rand(alpha.shape, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("size", [1, 2, 5, 16, 256])
def test_weights_match_the_published_procedure(size: int, generator: torch.Generator):
    alpha, distance = random_fragments(50, 40, generator)
    distance[:20] = (4 * distance[:20]).round()  # many ties: the first in the list is in front
    weights, left = hybrid_weights(alpha, distance, size)
    for pixel in range(len(alpha)):
        expected, transmittance = one_pixel(alpha[pixel].tolist(), distance[pixel].tolist(), size)
        torch.testing.assert_close(weights[pixel], torch.tensor(expected, dtype=torch.float64), rtol=1e-12, atol=1e-15)
        assert left[pixel].item() == pytest.approx(transmittance, rel=1e-12)


def test_weights_and_transmittance_sum_to_one(generator: torch.Generator):
    weights, left = hybrid_weights(*random_fragments(200, 60, generator), 14)
    covered = left == 0  # the core ended early and what was left, less than 1e-4, counts as nothing
    assert covered.any() and not covered.all()
    sums = weights.sum(-1) + left
    torch.testing.assert_close(sums[~covered], torch.ones_like(sums[~covered]), rtol=1e-12, atol=0)
    assert ((sums[covered] > 1 - 1e-4) & (sums[covered] <= 1)).all()
    for nothing in (torch.zeros(3, 0), torch.zeros(3, 2)):
        weights, left = hybrid_weights(nothing, nothing + 1, 16)
        assert not weights.any() and torch.equal(left, torch.ones(3))


def test_the_tail_lies_behind_the_core_and_nothing_behind_one_that_ends_early():
    alpha = torch.tensor([[0.9, 0.95, 0.99, 0.5, 0.03]], dtype=torch.float64)
    weights, left = hybrid_weights(alpha, torch.tensor([[1.0, 2.0, 3.0, 4.0, 0.5]], dtype=torch.float64), 16)
    torch.testing.assert_close(weights, torch.tensor([[0.9, 0.095, 0.00495, 0.0, 0.0]], dtype=torch.float64))
    assert left.item() == 0
    for distance in (1.0, 3.0):  # of the fog
        weights, left = hybrid_weights(torch.tensor([[0.04, 0.5]]), torch.tensor([[distance, 2.0]]), 16)
        torch.testing.assert_close(weights, torch.tensor([[0.02, 0.5]]))
        torch.testing.assert_close(left, torch.tensor([0.48]))


@pytest.mark.parametrize("size", [1, 3, 16, 64])
def test_derivatives_match_differences(size: int, generator: torch.Generator):
    alpha, distance = random_fragments(6, 9, generator)
    inside = alpha.clamp(max=0.9).requires_grad_()
    drawn = alpha > 0  # what is not drawn is 0 by definition, and stays so

    def blend(x: Tensor) -> tuple[Tensor, Tensor]:
        return hybrid_weights(torch.where(drawn, x, torch.zeros_like(x)), distance, size)

    assert torch.autograd.gradcheck(blend, inside)
