"""Growth by error, and splits along the longest axis."""

import math

import pytest
import torch

from padgs.gaussians import rotation_matrices
from padgs.geometry import harmonics
from padgs.methods.plus.method import PlusMethod, PlusOptions
from padgs.methods.splats.densification import DensificationOptions, Densifier
from padgs.methods.splats.error_growth import PIXELS, VIEWS, WrongPixels
from padgs.methods.splats.splats import Splats
from padgs.render import Rendering
from padgs.scene import View
from padgs.training.options import Budget
from tests.support.states import assert_same_but_time
from tests.support.tiny_scene import tiny_scene

WIDTH, HEIGHT, DISTANCE = 16, 8, 3.0
QUATERNION = torch.tensor([0.8, 0.3, -0.4, 0.2])


def view(pixels: torch.Tensor) -> View:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation_matrices(QUATERNION).double(), torch.tensor([0.5, -1.0, 2.0])
    return View("view", pose, WIDTH, HEIGHT, load_pixels=lambda: pixels)


def wrong_at(pixels: dict[tuple[int, int], float], transmittance: float = 0.0) -> tuple[View, Rendering]:
    """A black photograph that is rendered too bright at some pixels, on a sphere around the camera."""
    image, flat = torch.zeros(HEIGHT, WIDTH, 3), torch.full((HEIGHT, WIDTH), DISTANCE)
    for (row, column), error in pixels.items():
        image[row, column] = error
    rendering = Rendering(image, torch.full_like(flat, transmittance), flat, torch.ones(1, dtype=torch.bool))
    return view(torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)), rendering


def taken(*renders: tuple[View, Rendering], count: int) -> dict[str, torch.Tensor]:
    pixels = WrongPixels(torch.Generator().manual_seed(0))
    for one in renders:
        pixels.observe(*one)
    rows = pixels.take(count, Splats(torch.zeros(1, 3), torch.zeros(1, 3), torch.zeros(1, 3)).rows())
    assert len(pixels.rows) == 0, "all candidates are forgotten"
    return rows


def test_a_new_gaussian_is_at_the_wrong_pixel_and_as_wide():
    camera, rendering = wrong_at({(2, 5): 0.4})
    rows = taken((camera, rendering), count=7)  # but the same Gaussian twice would stay the same
    ray = camera.camera.rays(dtype=torch.float64)[2, 5]
    place = camera.cam_from_world.inverse() @ torch.cat((DISTANCE * ray, torch.ones(1).double()))
    assert torch.allclose(rows["means"], place[:3].float().expand(1, 3), atol=1e-5)
    pixel = 2 * math.pi / WIDTH * DISTANCE
    assert torch.allclose(rows["log_scales"].exp(), torch.full((1, 3), 0.45 * pixel))
    assert torch.equal(rows["quats"], torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(1, 1))
    assert torch.allclose(rows["opacity_logits"].sigmoid(), torch.full((1,), 0.5))
    assert torch.allclose(0.5 + harmonics.DC * rows["sh_dc"], torch.zeros(1, 3), atol=2e-3), "colour of the photograph"
    assert not rows["sh_rest"].any()


def test_pixels_are_drawn_by_error_and_solid_angle():
    """Rows 0 and 3 of 8, at 78.75 and 11.25 degrees; the other view is wrong three times as much there."""
    pixels = WrongPixels(torch.Generator().manual_seed(0))
    for one in (wrong_at({(0, 1): 0.2, (3, 9): 0.2}), wrong_at({(3, 2): 0.6})):
        pixels.observe(*one)
    candidates, splats = pixels.rows, Splats(torch.zeros(1, 3), torch.zeros(1, 3), torch.zeros(1, 3))
    weighted = candidates[candidates[:, -1] > 0]
    weights = torch.tensor([0.2, 0.2, 0.6]) * torch.tensor([78.75, 11.25, 11.25]).deg2rad().cos()
    expected = (weights / weights.sum()).tolist()
    assert (weighted[:, -1] / weighted[:, -1].sum()).tolist() == pytest.approx(expected, abs=0.02)
    drawn = torch.zeros(3)
    for _ in range(300):
        pixels.rows = candidates
        drawn += (pixels.take(1, splats.rows())["means"] == weighted[:, :3]).all(-1)
    assert (drawn / 300).tolist() == pytest.approx(expected, abs=0.1)


def test_pixels_without_a_surface_or_an_error_give_nothing():
    assert len(taken(wrong_at({(2, 5): 0.4}, transmittance=0.2), count=5)["means"]) == 0
    assert len(taken(wrong_at({}), count=5)["means"]) == 0


def test_only_the_last_views_count():
    pixels = WrongPixels(torch.Generator().manual_seed(0))
    for number in range(VIEWS + 1):
        pixels.observe(*wrong_at({(2, 5): 0.4} if number else {(6, 1): 0.4}))
    assert len(pixels.rows) == VIEWS * PIXELS and (pixels.rows[:, -1] > 0).sum() == VIEWS
    assert (pixels.rows[:, :3] - pixels.rows[0, :3]).abs().max() < 1e-5


def test_pieces_of_the_longest_axis_keep_its_variance_and_the_opacity_of_the_middle():
    scales, opacity = torch.tensor([0.2, 1.0, 0.4]), 0.7
    splats = Splats(torch.zeros(2, 3), scales.log().repeat(2, 1), torch.rand(2, 3))
    splats.quats.data, splats.opacity_logits.data = QUATERNION.repeat(2, 1), torch.full((2,), opacity).logit()
    optimizer = torch.optim.Adam(splats.parameters(), lr=0.0, fused=True)
    grown = Densifier(splats, DensificationOptions(densify_from=0, densify_every=10, split="long_axis"), extent=1.0)
    grown.observe(torch.tensor([[0.0, 0.0], [1.0, 0.0]]), torch.ones(2, dtype=torch.bool), iteration=1)
    assert grown.adapt(10, optimizer) == ("cloned 0, split 1, pruned 0 Gaussians",)
    means, widths = splats.means[1:], splats.log_scales[1:].exp()
    axis = rotation_matrices(QUATERNION)[:, 1]
    assert torch.allclose(means, torch.stack((0.7 * axis, -0.7 * axis)), atol=1e-6)
    assert torch.allclose(widths[:, 1].square() + 0.7**2, torch.ones(2)), "variance of the pair"
    assert torch.allclose(widths[:, [0, 2]], 0.7 * scales[[0, 2]].expand(2, 2))
    alpha = splats.opacity_logits[1:].sigmoid() * torch.exp(-0.5 * 0.7**2 / widths[:, 1].square())
    assert (1 - (1 - alpha).prod()).item() == pytest.approx(opacity, abs=1e-5)


def test_a_run_that_grows_by_error_resumes_bit_identically():
    options = PlusOptions(error_share=0.5, split="long_axis", gradient_threshold=1e-9)
    whole, resumed = PlusMethod(options), PlusMethod(options)
    events = []
    for record in whole.fit(tiny_scene(), Budget(60)):
        events += record.events
        if record.iteration == 13:
            resumed.load_state(whole.state())
    assert any("at pixels, cloned" in event for event in events)
    list(resumed.fit(tiny_scene(), Budget(60)))
    assert_same_but_time(resumed.state(), whole.state())


@pytest.mark.parametrize(("option", "value"), [("error_share", 1.5), ("split", "short_axis")])
def test_impossible_options_are_refused(option, value):
    with pytest.raises(ValueError, match=option):
        DensificationOptions(**{option: value})
