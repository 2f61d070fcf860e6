from dataclasses import replace

import pytest
import torch
from tiny_scene import tiny_scene, truth

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Panorama, Pinhole, RayTable
from padgs.methods.calibration.lenses import DualLens
from padgs.render import RenderOptions, render
from padgs.scene import View
from padgs.training.model import TrainingRender

VIEW = tiny_scene().train[3]


def drawer(gaussians: Gaussians, projection: str = "ray", backend: str = "torch"):
    def draw(view: View, mean_offsets: torch.Tensor | None = None) -> TrainingRender:
        offsets = mean_offsets
        if offsets is None:
            offsets = gaussians.means.new_zeros(len(gaussians), 2, requires_grad=True)
        rendering = render(gaussians, view, RenderOptions(projection), mean_offsets=offsets, backend=backend)
        return TrainingRender(rendering, offsets, gaussians, torch.arange(len(gaussians)))

    return draw


@pytest.mark.parametrize("projection", ["ray", "tangent"])
@pytest.mark.parametrize("backend", ["torch", "auto"])
def test_lenses_in_one_place_that_bend_nothing_are_the_ideal_camera_to_the_bit(projection, backend):
    draw = drawer(truth(), projection, backend)
    table = replace(VIEW, lens=RayTable(VIEW.camera.rays(dtype=torch.float64).float(), VIEW.camera.focal))
    for axis in "xyz":
        lenses = DualLens(axis=axis)
        with torch.no_grad():
            stitched = lenses.draw(draw, VIEW).rendering
        plain = draw(table).rendering
        assert torch.equal(stitched.image, plain.image) and torch.equal(stitched.depth, plain.depth)


def test_each_lens_stands_on_its_own_side():
    lenses = DualLens(axis="z", scene_scale=2.0)
    with torch.no_grad():
        lenses.gap.fill_(0.1)
    front, back = lenses.lenses(VIEW)
    ahead = VIEW.cam_from_world[:3, :3].T @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(front.center, VIEW.center + 0.1 * ahead)
    torch.testing.assert_close(back.center, VIEW.center - 0.1 * ahead)


def test_what_each_lens_shows_is_its_own_half():
    lenses, draw = DualLens(axis="z", blend=5.0), drawer(truth())
    with torch.no_grad():
        lenses.gap.fill_(0.3)
        image = lenses.draw(draw, VIEW).rendering.image
        front, back = (draw(view).rendering.image for view in lenses.lenses(VIEW))
    forward = VIEW.camera.rays()[..., 2]
    assert torch.equal(image[forward > 0.1], front[forward > 0.1])
    assert torch.equal(image[forward < -0.1], back[forward < -0.1])
    assert (front - back).abs().max() > 0.1


def test_gradients_are_those_of_differences():
    """Of gap and coefficients, through poses, ray tables, blending and the renderer."""
    lenses = DualLens(axis="x", blend=20.0, scene_scale=2.0).double()
    draw = drawer(truth().to(torch.float64))
    weight = torch.randn(*VIEW.image().shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    with torch.no_grad():
        lenses.gap.fill_(0.05)
        lenses.coefficients.copy_(torch.tensor([[0.01, -0.002], [-0.02, 0.003]]))

    def loss() -> torch.Tensor:
        return (lenses.draw(draw, VIEW).rendering.image * weight).sum()

    loss().backward()
    for parameter in (lenses.gap, lenses.coefficients):
        values, gradient = parameter.data.view(-1), parameter.grad.view(-1)
        for k in range(len(values)):
            sides = []
            for step in (1e-6, -1e-6):
                values[k] += step
                sides.append(loss().item())
                values[k] -= step
            assert gradient[k].item() == pytest.approx((sides[0] - sides[1]) / 2e-6, rel=1e-4, abs=1e-4)


def test_both_lenses_add_to_one_positional_gradient():
    lenses, draw = DualLens(), drawer(truth())
    drawing = lenses.draw(draw, VIEW)
    drawing.rendering.image.sum().backward()
    assert drawing.mean_offsets.grad is not None and (drawing.mean_offsets.grad.norm(dim=-1) > 0).sum() > 4


def test_only_panoramas_are_stitched():
    pinhole = replace(VIEW, lens=Pinhole(32, 16, 10.0, 10.0, 16.0, 8.0))
    with pytest.raises(ValueError, match="is a Pinhole; two lenses make a Panorama"):
        DualLens().lenses(pinhole)
    assert isinstance(VIEW.camera, Panorama)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"order": 0}, "0 coefficients"),
        ({"blend": 90.0}, r"90.0 degrees to each side; it must be in \[0, 90\)"),
        ({"axis": "forward"}, "unknown lens axis 'forward'"),
    ],
)
def test_meaningless_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        DualLens(**options)
