import math
from dataclasses import replace

import pytest
import torch
from tiny_scene import tiny_scene, truth

from padgs.evaluation.diagnostics import depth_error, depth_within, diagnose, floaters, least_extent, yaw_error
from padgs.evaluation.metrics import mean_color
from padgs.geometry.distortion import solid_angle_weight
from padgs.render import Rendering, RenderOptions, render

SURFACE = torch.full((16, 32), 2.0)
TOP = solid_angle_weight(16)[:4].sum() / solid_angle_weight(16).sum()  # share of the sphere in the upper four rows


def upper(value: float) -> torch.Tensor:
    depth = SURFACE.clone()
    depth[:4] = value
    return depth


def test_errors_of_depth_are_relative_and_count_by_solid_angle():
    assert depth_error(SURFACE, SURFACE) == 0 and depth_within(SURFACE, SURFACE) == 1
    assert depth_error(upper(3.0), SURFACE).item() == pytest.approx(0.5 * TOP.item())
    assert depth_within(upper(3.0), SURFACE).item() == pytest.approx(1 - TOP.item())
    assert depth_within(upper(0.0), SURFACE).item() == pytest.approx(1 - TOP.item())  # nothing was drawn there


def test_the_sky_is_not_measured():
    assert depth_error(SURFACE, upper(math.inf)) == 0 and floaters(upper(1.0), torch.ones(16, 32), upper(math.inf)) == 0
    assert depth_error(SURFACE, torch.full_like(SURFACE, math.inf)).isnan()


def test_what_hangs_in_front_floats_as_far_as_it_is_opaque():
    opaque = torch.ones(16, 32)
    assert floaters(upper(1.0), opaque, SURFACE).item() == pytest.approx(TOP.item())
    assert floaters(upper(1.0), 0.25 * opaque, SURFACE).item() == pytest.approx(0.25 * TOP.item())
    assert floaters(upper(1.95), opaque, SURFACE) == 0  # within 5 %
    assert floaters(upper(9.0), opaque, SURFACE) == 0  # behind


def test_what_has_collapsed_onto_a_plane_or_a_point_is_thin():
    assert least_extent(SURFACE, SURFACE).item() == pytest.approx(1)
    assert least_extent(0.5 * SURFACE, SURFACE).item() == pytest.approx(0.5)
    disc = torch.zeros(16, 32)
    disc[7:9] = 2.0  # all of it within 11 degrees of the horizon
    assert least_extent(disc, SURFACE) < 0.1 and least_extent(0 * SURFACE, SURFACE) == 0
    assert least_extent(upper(9.0), upper(math.inf)).item() == pytest.approx(1), "the sky is not measured"
    assert least_extent(SURFACE, torch.full_like(SURFACE, math.inf)).isnan()


@pytest.mark.parametrize(("wrap", "sees"), [(True, False), (False, True)])
def test_a_renderer_with_a_seam_does_not_draw_the_same_when_it_looks_back(wrap, sees):
    view, gaussians = tiny_scene().test[0], truth()
    gaussians.means[0] = torch.tensor([0.0, 0.0, -2.0])  # on the seam

    def drawn(view):
        return render(gaussians, view, RenderOptions(wrap=wrap), backend="torch")

    error = yaw_error(drawn, view, drawn(view).image).item()
    assert (error > 0.05) if sees else (error < 1e-4)


def test_a_view_without_depth_or_that_is_no_panorama_has_marks_that_are_missing():
    view = tiny_scene().test[0]
    image = torch.zeros(16, 32, 3)
    rendering = Rendering(image, torch.zeros(16, 32), SURFACE, torch.ones(1, dtype=torch.bool))
    marks = diagnose(lambda _: rendering, view, rendering)
    assert marks["yaw_error"] == 0 and marks["depth_error"] is None and marks["floaters"] is None
    known = diagnose(lambda _: rendering, replace(view, load_depth=lambda: SURFACE), rendering)
    assert (known["depth_error"], known["depth_within"], known["floaters"]) == (0, 1, 0)
    assert known["least_extent"] == pytest.approx(1) and marks["least_extent"] is None


def test_one_colour_is_that_of_the_sphere_and_not_of_the_image():
    target = torch.zeros(16, 32, 3)
    target[:8] = 1.0
    assert mean_color(target).item() == pytest.approx(-10 * math.log10(0.25))
    mask = torch.zeros(16, 32)
    mask[:8] = 1
    assert mean_color(target, mask) > 100
