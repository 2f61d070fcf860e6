"""Camera models: the map of a panoramic camera, and two fisheye lenses."""

from dataclasses import replace

import pytest
import torch
from support.tiny_scene import tiny_scene, truth

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Panorama, Pinhole, RayTable
from padgs.geometry.panorama import direction, rays, sample_pixels
from padgs.methods.calibration.lenses import CameraMap, DualLens
from padgs.render import RenderOptions, render
from padgs.scene import View
from padgs.training.model import TrainingRender

W, H = 64, 32


def smooth(size: float = 0.03, seed: int = 0) -> torch.Tensor:
    """A smooth field [H, W, 3] on the sphere: a random quadratic form of the direction."""
    generator = torch.Generator().manual_seed(seed)
    d = rays(W, H, dtype=torch.float64)
    quadratic = torch.randn(3, 3, 3, generator=generator, dtype=torch.float64)
    return size * torch.einsum("hwi,cij,hwj->hwc", d, quadratic, d)


def distorted(size: float = 0.03) -> CameraMap:
    camera = CameraMap(W, H, dtype=torch.float64)
    with torch.no_grad():
        camera.focal.copy_(torch.tensor([1.02, 0.99, 1.0]))
        camera.offsets.copy_(smooth(size))
    return camera


def test_ideal_camera_is_the_identity(generator):
    camera, image = CameraMap(W, H), torch.rand(H, W, 3, generator=generator)
    assert torch.equal(sample_pixels(image, camera.source_pixels()), image)
    assert torch.equal(sample_pixels(image, camera.ideal_pixels()), image)
    assert camera.roughness() == 0


def test_ideal_pixels_invert_source_pixels(generator):
    """The inverse map, sampled at where the map leads, leads back: to a small share of a pixel away from the poles."""
    camera = distorted()
    there, back = camera.source_pixels(), camera.ideal_pixels()
    longitude, latitude = ((back / torch.tensor([W, H]) - 0.5) * torch.tensor([2 * torch.pi, torch.pi])).unbind(-1)
    found = torch.nn.functional.normalize(sample_pixels(direction(longitude, latitude), there), dim=-1)
    off = (found - rays(W, H, dtype=torch.float64)).norm(dim=-1) * (W / (2 * torch.pi))
    moved = (camera.directions() - rays(W, H, dtype=torch.float64)).norm(dim=-1) * (W / (2 * torch.pi))
    assert moved.mean() > 0.2, "in pixels: the camera is distorted"
    assert off.max() < 0.03 and off.mean() < 0.006


def test_rotations_are_removed_from_the_map():
    """A rotation of all cameras in their own frames is left to the poses."""
    camera = CameraMap(W, H, dtype=torch.float64)
    d = rays(W, H, dtype=torch.float64)
    turn = torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64)
    with torch.no_grad():
        camera.offsets.copy_(torch.linalg.cross(turn.expand_as(d), d))
    assert (camera.directions() - d).abs().max() < 1e-4  # the mean over pixels is that over the sphere up to 1/H^2


def assert_gradients_match_differences(loss, entries, step: float, tolerance: float) -> None:
    """Compare gradients of `loss()` at entries (parameter, index) with central differences."""
    loss().backward()
    for parameter, place in entries:
        sides = []
        for moved in (step, -step):
            with torch.no_grad():
                parameter[place] += moved
                sides.append(loss().item())
                parameter[place] -= moved
        expected = (sides[0] - sides[1]) / (2 * step)
        assert parameter.grad[place].item() == pytest.approx(expected, rel=tolerance, abs=tolerance)


def test_gradients_of_the_map(generator):
    camera = distorted()
    image, weight = torch.randn(2, H, W, 3, generator=generator, dtype=torch.float64)
    places = [(0, 3, 1), (15, 0, 0), (16, 63, 2), (31, 40, 1), (8, 30, 0)]
    entries = [(camera.focal, k) for k in range(3)] + [(camera.offsets, place) for place in places]

    def loss() -> torch.Tensor:
        return (sample_pixels(image, camera.source_pixels()) * weight).sum() + camera.roughness()

    assert_gradients_match_differences(loss, entries, 1e-7, 1e-5)


def test_roughness_of_a_linear_field_is_its_slope():
    """D = a d.y along one axis, a times the sine of the latitude: its slope is a times the cosine, pi/4 on average."""
    rough, latitude_sine = [], rays(256, 128, dtype=torch.float64)[..., 1]
    for scale in (1.0, 2.0, -1.0):  # -1: upside down
        camera = CameraMap(256, 128, dtype=torch.float64)
        with torch.no_grad():
            camera.offsets[..., 0] = scale * latitude_sine
        rough.append(camera.roughness().item())
    assert rough == pytest.approx([torch.pi / 4, torch.pi / 2, torch.pi / 4], rel=1e-3)
    assert rough[2] == pytest.approx(rough[0], rel=1e-12)


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
def test_initial_lenses_are_bit_equal_to_the_ideal_camera(projection, backend):
    draw = drawer(truth(), projection, backend)
    table = replace(VIEW, lens=RayTable(VIEW.camera.rays(dtype=torch.float64).float(), VIEW.camera.focal))
    for axis in "xyz":
        lenses = DualLens(axis=axis)
        with torch.no_grad():
            stitched = lenses.draw(draw, VIEW).rendering
        plain = draw(table).rendering
        assert torch.equal(stitched.image, plain.image) and torch.equal(stitched.depth, plain.depth)


def test_positions_of_the_lenses():
    lenses = DualLens(axis="z", scene_scale=2.0)
    with torch.no_grad():
        lenses.gap.fill_(0.1)
    front, back = lenses.lenses(VIEW)
    ahead = VIEW.cam_from_world[:3, :3].T @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(front.center, VIEW.center + 0.1 * ahead)
    torch.testing.assert_close(back.center, VIEW.center - 0.1 * ahead)


def test_each_lens_renders_its_own_half():
    lenses, draw = DualLens(axis="z", blend=5.0), drawer(truth())
    with torch.no_grad():
        lenses.gap.fill_(0.3)
        image = lenses.draw(draw, VIEW).rendering.image
        front, back = (draw(view).rendering.image for view in lenses.lenses(VIEW))
    forward = VIEW.camera.rays()[..., 2]
    assert torch.equal(image[forward > 0.1], front[forward > 0.1])
    assert torch.equal(image[forward < -0.1], back[forward < -0.1])
    assert (front - back).abs().max() > 0.1


def test_gradients_of_the_lenses():
    """Check gap and coefficients, through poses, ray tables, blending and the renderer."""
    lenses = DualLens(axis="x", blend=20.0, scene_scale=2.0).double()
    draw = drawer(truth().to(torch.float64))
    weight = torch.randn(*VIEW.image().shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    with torch.no_grad():
        lenses.gap.fill_(0.05)
        lenses.coefficients.copy_(torch.tensor([[0.01, -0.002], [-0.02, 0.003]]))
    entries = [(lenses.gap, ()), *((lenses.coefficients, (lens, k)) for lens in (0, 1) for k in (0, 1))]
    assert_gradients_match_differences(
        lambda: (lenses.draw(draw, VIEW).rendering.image * weight).sum(), entries, 1e-6, 1e-4
    )


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
def test_invalid_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        DualLens(**options)
