import math
from dataclasses import replace

import pytest
import torch
from support.tiny_scene import tiny_scene, truth

from padgs.evaluation.diagnostics import (
    blurred,
    depth_error,
    depth_within,
    diagnose,
    floaters,
    least_extent,
    oracle,
    pole_gap,
    yaw_error,
)
from padgs.evaluation.metrics import mean_color, sphere_weight, ws_psnr
from padgs.geometry.distortion import solid_angle_weight
from padgs.geometry.panorama import rays, row_latitudes, sample
from padgs.render import Rendering, RenderOptions, render

WIDTH, HEIGHT = 192, 96
SURFACE = torch.full((16, 32), 2.0)
TOP = solid_angle_weight(16)[:4].sum() / solid_angle_weight(16).sum()  # share of the sphere in the upper four rows


def upper(value: float) -> torch.Tensor:
    depth = SURFACE.clone()
    depth[:4] = value
    return depth


def test_depth_errors_are_relative_and_weighted_by_solid_angle():
    assert depth_error(SURFACE, SURFACE) == 0 and depth_within(SURFACE, SURFACE) == 1
    assert depth_error(upper(3.0), SURFACE).item() == pytest.approx(0.5 * TOP.item())
    assert depth_within(upper(3.0), SURFACE).item() == pytest.approx(1 - TOP.item())
    assert depth_within(upper(0.0), SURFACE).item() == pytest.approx(1 - TOP.item())  # nothing was rendered there


def test_the_sky_is_not_measured():
    assert depth_error(SURFACE, upper(math.inf)) == 0 and floaters(upper(1.0), torch.ones(16, 32), upper(math.inf)) == 0
    assert depth_error(SURFACE, torch.full_like(SURFACE, math.inf)).isnan()


def test_floaters_are_weighted_by_alpha():
    opaque = torch.ones(16, 32)
    assert floaters(upper(1.0), opaque, SURFACE).item() == pytest.approx(TOP.item())
    assert floaters(upper(1.0), 0.25 * opaque, SURFACE).item() == pytest.approx(0.25 * TOP.item())
    assert floaters(upper(1.95), opaque, SURFACE) == 0  # within 5 %
    assert floaters(upper(9.0), opaque, SURFACE) == 0  # behind


def test_least_extent_detects_collapse():
    assert least_extent(SURFACE, SURFACE).item() == pytest.approx(1)
    assert least_extent(0.5 * SURFACE, SURFACE).item() == pytest.approx(0.5)
    disc = torch.zeros(16, 32)
    disc[7:9] = 2.0  # all within 11 degrees of the horizon
    assert least_extent(disc, SURFACE) < 0.1 and least_extent(0 * SURFACE, SURFACE) == 0
    assert least_extent(upper(9.0), upper(math.inf)).item() == pytest.approx(1)
    for unknown in (math.inf, 0.0):
        assert least_extent(SURFACE, torch.full_like(SURFACE, unknown)).isnan()


@pytest.mark.parametrize(("wrap", "sees"), [(True, False), (False, True)])
def test_yaw_error_detects_a_seam(wrap, sees):
    view, gaussians = tiny_scene().test[0], truth()
    gaussians.means[0] = torch.tensor([0.0, 0.0, -2.0])  # on the seam

    def drawn(view):
        return render(gaussians, view, RenderOptions(wrap=wrap), backend="torch")

    error = yaw_error(drawn, view, drawn(view).image).item()
    assert (error > 0.05) if sees else (error < 1e-4)


def test_diagnostics_without_ground_truth_are_missing():
    view = tiny_scene().test[0]
    image = torch.zeros(16, 32, 3)
    rendering = Rendering(image, torch.zeros(16, 32), SURFACE, torch.ones(1, dtype=torch.bool))
    metrics = diagnose(lambda _: rendering, view, rendering)
    assert metrics["yaw_error"] == 0 and metrics["depth_error"] is None and metrics["floaters"] is None
    known = diagnose(lambda _: rendering, replace(view, load_depth=lambda: SURFACE), rendering)
    assert (known["depth_error"], known["depth_within"], known["floaters"]) == (0, 1, 0)
    assert known["least_extent"] == pytest.approx(1) and metrics["least_extent"] is None


def test_hidden_pixels_have_no_depth():
    view, mask = tiny_scene().test[0], torch.zeros(16, 32)
    mask[:8] = 1
    wrong = torch.where(mask > 0, SURFACE, 0.5 * SURFACE)  # a floater below
    rendering = Rendering(torch.zeros(16, 32, 3), torch.zeros(16, 32), wrong, torch.ones(1, dtype=torch.bool))
    known = diagnose(lambda _: rendering, replace(view, load_depth=lambda: SURFACE), rendering, mask)
    assert (known["depth_error"], known["depth_within"], known["floaters"]) == (0, 1, 0)
    assert known["least_extent"] == pytest.approx(1)
    assert diagnose(lambda _: rendering, replace(view, load_depth=lambda: SURFACE), rendering)["depth_error"] > 0.2


def test_mean_color_is_weighted_by_solid_angle():
    target = torch.zeros(16, 32, 3)
    target[:8] = 1.0
    assert mean_color(target, sphere_weight(target)).item() == pytest.approx(-10 * math.log10(0.25))
    mask = torch.zeros(16, 32)
    mask[:8] = 1
    assert mean_color(target, sphere_weight(target, mask)) > 100


def detail(pole: float, equator: float = 0.2) -> torch.Tensor:
    """Return waves in three directions with given amplitudes at the poles and at the horizon."""
    waves = torch.sin(9 * rays(WIDTH, HEIGHT)).prod(-1, keepdim=True).expand(-1, -1, 3)
    share = torch.sin(row_latitudes(HEIGHT)).abs()[:, None, None]
    return 0.5 + (equator + (pole - equator) * share) * waves


def test_pole_gap_is_the_difference_of_two_bands():
    target, latitudes = torch.zeros(HEIGHT, WIDTH, 3), row_latitudes(HEIGHT).rad2deg().abs()[:, None, None]
    image = torch.where(latitudes > 75, 0.1, torch.where(latitudes < 30, 0.01, 0.5)).expand_as(target)
    assert pole_gap(image, target).item() == pytest.approx(20)
    hidden = (latitudes[..., 0] < 75).float().expand(HEIGHT, WIDTH)
    assert pole_gap(image, target, hidden).isnan()


def test_blur_is_isotropic():
    """Blur of a Gaussian spot on the horizon, at a pole and on the seam: wider, with the same sum."""
    spot, sigma = 0.15, 0.1
    weight = row_latitudes(HEIGHT).cos()[:, None]
    for center in ([0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, -0.98, 0.2], [0.0, 0.0, -1.0]):
        at = torch.nn.functional.normalize(torch.tensor(center), dim=0)
        image = torch.exp(((rays(WIDTH, HEIGHT) * at).sum(-1, keepdim=True) - 1) / spot**2)
        wide = blurred(image, sigma)
        assert (wide[..., 0] * weight).sum() == pytest.approx((image[..., 0] * weight).sum().item(), rel=0.01)
        assert sample(wide, at).item() == pytest.approx(spot**2 / (spot**2 + sigma**2), rel=0.05)


def test_blur_continues_beyond_the_poles():
    """A blur of directions changes only their length."""
    ahead = rays(WIDTH, HEIGHT)
    for sigma in (0.01, 0.1):  # the first reaches half a pixel across a pole
        assert (blurred(ahead, sigma) - ahead * math.exp(-(sigma**2))).abs().max() < 5e-4


def test_oracle_has_the_ws_psnr_of_the_image():
    gaps = []
    for target in (detail(0.02), detail(0.3, 0.02)):
        image = target + 0.02 * torch.randn(target.shape, generator=torch.Generator().manual_seed(0))
        found = oracle(image, target)
        assert found is not None
        assert ws_psnr(found, target).item() == pytest.approx(ws_psnr(image, target).item(), abs=0.2)
        gaps.append(pole_gap(found, target).item())
    assert gaps[0] < -5 and gaps[1] > 3


def test_isotropic_blur_has_the_gap_of_its_oracle():
    target = detail(0.05)
    image = blurred(target, 0.03)
    found = oracle(image, target)
    assert found is not None and abs(pole_gap(image, target) - pole_gap(found, target)) < 0.2
    worse = image.clone()
    worse[row_latitudes(HEIGHT).abs() > math.radians(70)] = 0.5  # poles that were not learned
    found = oracle(worse, target)
    assert found is not None and pole_gap(worse, target) - pole_gap(found, target) > 3


@pytest.mark.parametrize("error", [0.0, 0.6])
def test_no_oracle_beyond_the_range_of_blurs(error):
    target = detail(0.2)
    assert oracle(target + error, target) is None
