"""Low-pass kinds in every projection: width, opacity and gradients."""

import math
from dataclasses import replace

import pytest
import torch
from support import render_cases as cases

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Camera, Panorama, Pinhole
from padgs.geometry.panorama import direction
from padgs.render import RenderOptions, render
from padgs.render.contract import LOW_PASS_KINDS
from padgs.render.projection import PROJECTIONS, PlanarFootprints
from padgs.scene import View

COMBINATIONS = [(projection, kind) for projection, kinds in LOW_PASS_KINDS.items() for kind in kinds]
each_combination = pytest.mark.parametrize(("projection", "kind"), COMBINATIONS)
each_projection = pytest.mark.parametrize("projection", LOW_PASS_KINDS)
VARIANCE = 0.5  # square pixels


def camera_of(projection: str, width: int = 64) -> Camera:
    if projection == "pinhole":
        return Pinhole(width, width // 2, 0.6 * width, 0.6 * width, 0.5 * width, 0.25 * width)
    return Panorama(width, width // 2)


def options_of(projection: str, kind: str, **more) -> RenderOptions:
    return RenderOptions(projection=projection, low_pass=VARIANCE, low_pass_kind=kind, **more)


def small(latitude: float, scale: float, radius: float = 2.0) -> Gaussians:
    """Return a round Gaussian at a latitude in radians; `scale` is relative to its distance."""
    mean = radius * direction(torch.tensor([0.05]).double(), torch.tensor([latitude]).double())
    quats, opacities = torch.tensor([[1.0, 0, 0, 0]]).double(), torch.tensor([0.9]).double()
    scales = torch.full((1, 3), radius * scale, dtype=torch.float64)
    return Gaussians(mean, quats, scales, opacities, torch.tensor([[1.0, 0.5, 0.25]]).double())


def test_kinds_of_every_projection():
    assert set(LOW_PASS_KINDS) == set(PROJECTIONS)
    natural = {projection: RenderOptions(projection=projection).resolved_low_pass_kind for projection in PROJECTIONS}
    assert natural == {"erp": "pixels", "pinhole": "pixels", "tangent": "angular", "ray": "solid"}
    assert all("solid" in kinds for kinds in LOW_PASS_KINDS.values())


@pytest.mark.parametrize("latitude", [0.0, 0.9, -1.4])
def test_a_point_becomes_a_circle_of_pixels_or_angle(latitude: float):
    camera, point = camera_of("erp"), small(latitude, 1e-9)
    widths = {}
    for kind in ("pixels", "angular"):
        footprints = cases.projected(point, cases.identity_pose(), camera, options_of("erp", kind))
        assert isinstance(footprints, PlanarFootprints)
        a, b, c = footprints.whitening[0].tolist()
        assert abs(b) < 1e-9
        widths[kind] = 1 / a**2, 1 / c**2
        assert torch.equal(footprints.opacities, point.opacities)
    assert widths["pixels"] == pytest.approx((VARIANCE, VARIANCE))
    assert widths["angular"] == pytest.approx((VARIANCE / math.cos(latitude) ** 2, VARIANCE))


@each_projection
def test_a_point_spans_the_same_angle_in_every_projection(projection: str):
    """Along a meridian: q = (gamma f)^2 / low_pass, for small angles gamma."""
    camera, point = camera_of(projection, 512), small(0.0, 1e-9)
    footprints = cases.projected(point, cases.identity_pose(), camera, options_of(projection, "angular"))
    row = camera.height // 2 + torch.arange(-2, 2)
    column = torch.full_like(row, int(camera.width * 0.5 + 0.05 * camera.focal))
    q, inside = footprints.squared_distance(torch.tensor([0]), row, column)
    offset = torch.arange(-2, 2) + 0.5
    across = camera.rays(dtype=torch.float64)[row, column] @ point.means[0] / 2
    angle = torch.acos(across.clamp(max=1)) * camera.focal  # pixels
    assert inside.all() and (angle >= offset.abs() - 3e-3).all()
    torch.testing.assert_close(q[:, 0], angle**2 / VARIANCE, rtol=2e-3, atol=0)


@each_projection
def test_solid_is_angular_with_the_opacity_of_the_larger_volume(projection: str, generator):
    gaussians = cases.mixture(20, generator, ("ordinary", "polar", "seam"))
    camera, pixels = camera_of(projection), torch.arange(64)
    kinds = ("angular", "solid")
    angular, solid = (
        cases.projected(gaussians, cases.identity_pose(), camera, options_of(projection, kind)) for kind in kinds
    )
    both = (angular.visible & solid.visible).nonzero()[:, 0]
    assert len(both) >= 2
    q = [footprints.squared_distance(both, pixels // 4, pixels)[0] for footprints in (angular, solid)]
    torch.testing.assert_close(q[0], q[1])
    radius = gaussians.means.norm(dim=-1, keepdim=True)
    volume = gaussians.scales**2 / (gaussians.scales**2 + VARIANCE * (radius / camera.focal) ** 2)
    expected = gaussians.opacities * volume.prod(-1).sqrt()
    torch.testing.assert_close(solid.opacities[both], expected[both])
    assert torch.equal(angular.opacities[both], gaussians.opacities[both])
    assert (solid.visible <= angular.visible).all()


@each_combination
def test_large_gaussians_change_little(projection: str, kind: str):
    camera, large = camera_of(projection), small(0.1, 0.15)  # 1.5 pixels of filter on a standard deviation of 6
    plain = render(large, View("v", cases.identity_pose(), 64, 32, lens=camera), options_of(projection, kind, near=0.1))
    none = replace(options_of(projection, kind, near=0.1), low_pass=0.0)
    sharp = render(large, View("v", cases.identity_pose(), 64, 32, lens=camera), none)
    wider = 1 + VARIANCE / (0.15 * camera.focal) ** 2
    faded = wider**-1.5 if kind == "solid" else 1.0
    assert plain.image.max() == pytest.approx(sharp.image.max().item() * faded, rel=0.01)
    assert plain.image.sum() == pytest.approx(sharp.image.sum().item() * wider * faded, rel=0.04)


@each_combination
def test_the_unit_of_length_does_not_matter(projection: str, kind: str):
    camera = camera_of(projection)
    images = []
    for radius in (0.5, 2.0, 300.0):
        gaussians = small(0.3, 0.02, radius)
        view = View("v", cases.identity_pose(), camera.width, camera.height, lens=camera)
        images.append(render(gaussians, view, options_of(projection, kind)).image)
    for image in images[1:]:
        torch.testing.assert_close(image, images[0], rtol=0, atol=1e-9)
    assert images[0].max() > 0.01


def thin_mixture(generator: torch.Generator) -> Gaussians:
    """Return thin Gaussians about as large as the filter, which it affects most."""
    gaussians = cases.mixture(25, generator, ("ordinary", "polar", "seam"))
    shrink = 0.1 + 0.6 * torch.rand(75, 3, generator=generator, dtype=torch.float64)
    opacities = 0.5 + 0.5 * gaussians.opacities
    return replace(gaussians, scales=gaussians.scales * shrink, opacities=opacities).to(torch.float32).to(torch.float64)


@each_combination
@cases.needs_native
def test_native_matches_the_definition(projection: str, kind: str, generator):
    gaussians, pose = thin_mixture(generator), cases.random_pose(generator, shift=0.05)
    camera, options = camera_of(projection, 96), options_of(projection, kind, near=0.02)
    weights = torch.rand(48, 96, 3, generator=generator, dtype=torch.float64)
    weights *= cases.stable_pixels(gaussians, 96, 48, lens=camera, pose=pose, options=options)[..., None]
    arguments = (gaussians, camera, options, weights)
    expected, expected_gradients = cases.differentiated(*arguments, pose=pose, backend="torch", dtype=torch.float64)
    actual, gradients = cases.differentiated(*arguments, pose=pose, backend="cpu", dtype=torch.float32)
    assert expected.counters["visible"] >= 5
    assert ((actual.image - expected.image).abs() * (weights > 0)).max() < 2e-5
    for name, gradient in gradients.items():
        assert cases.row_error(gradient, expected_gradients[name]) < 2e-3, name


@pytest.mark.parametrize("place", ["ordinary", "next to the pole", "across the seam"])
@each_combination
def test_gradients_match_differences(projection: str, kind: str, place: str, generator):
    """Gradients of each affected input against central differences in float64."""
    camera = camera_of(projection, 40)
    turn = {"ordinary": (0.2, 0.1), "next to the pole": (0.4, math.radians(89.9)), "across the seam": (math.pi, -0.3)}
    longitude, latitude = (0.2, 0.1) if projection == "pinhole" else turn[place]
    mean = 2 * direction(torch.tensor([longitude]).double(), torch.tensor([latitude]).double())
    gaussians = Gaussians(
        means=mean,
        quats=torch.randn(1, 4, generator=generator, dtype=torch.float64),
        scales=2 / camera.focal * torch.tensor([[0.9, 0.6, 1.2]]).double(),
        opacities=torch.tensor([0.8]).double(),
        colors=torch.tensor([[0.9, 0.5, 0.3]]).double(),
    )
    view, options = View("v", cases.identity_pose(), 40, 20, lens=camera), options_of(projection, kind)

    def drawn(*inputs: torch.Tensor) -> torch.Tensor:
        return render(Gaussians(*inputs), view, options).image

    inputs = vars(cases.leaves(gaussians, torch.float64)).values()
    assert torch.autograd.gradcheck(drawn, tuple(inputs), eps=1e-6, atol=1e-5, fast_mode=True)
