"""Camera models: the map of a panoramic camera, and two fisheye lenses."""

from dataclasses import replace

import pytest
import torch
from support.rates import assert_log_linear
from support.tiny_scene import tiny_scene, truth

from padgs.baselines.omnigs import OmniGSMethod
from padgs.baselines.seam360gs import Seam360GSMethod
from padgs.gaussians import Gaussians
from padgs.geometry.camera import Pinhole, RayTable
from padgs.geometry.panorama import direction, rays, sample_pixels
from padgs.render import RenderOptions, render
from padgs.scene import Scene, View
from padgs.training.corrections import Corrections
from padgs.training.lenses import CameraMap, DualLens, stitched
from padgs.training.model import TrainingRender
from padgs.training.options import Budget, TrainOptions
from padgs.training.targets import Targets

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


@pytest.mark.parametrize("lens", ["map", "fisheyes_y"])
def test_only_panoramas_have_a_lens_to_learn(lens):
    pinhole = replace(VIEW, lens=Pinhole(32, 16, 10.0, 10.0, 16.0, 8.0))
    scene = replace(tiny_scene(), train=(VIEW, pinhole))
    with pytest.raises(ValueError, match=f"train.lens is {lens}, but view .* is no panorama; set given"):
        Corrections(scene, TrainOptions(lens=lens))


def test_a_learned_map_refuses_depth_maps_that_it_would_not_resample():
    with pytest.raises(ValueError, match="train.lens=map resamples photographs, and not their depth maps"):
        Corrections(tiny_scene(), TrainOptions(lens="map", depth_weight=0.1))
    assert Corrections(tiny_scene(), TrainOptions(lens="fisheyes_y", depth_weight=0.1)).lens is not None


def test_masks_are_undistorted_with_the_image():
    mask = torch.ones(16, 32)
    mask[10:] = 0
    view, camera = replace(VIEW, load_mask=lambda: mask), CameraMap(32, 16)
    target = Targets([view], "solid_angle").at(0)[1]
    ideal = camera.undistorted(view, target, "solid_angle")
    assert torch.equal(ideal.image, target.image) and torch.equal(ideal.weight, target.weight)
    with torch.no_grad():
        camera.focal.copy_(torch.tensor([1.0, 1.5, 1.0]))  # rows move apart, away from the horizon
    stretched = camera.undistorted(view, target, "solid_angle")
    assert (stretched.weight[10:] == 0).all(), "what shows row 10 and beyond"
    assert (stretched.weight[9] < 0.5 * target.weight[9]).all() and torch.equal(stretched.weight[:9], target.weight[:9])
    assert stretched.image.requires_grad
    spoiled = replace(target, image=torch.where(mask[..., None] > 0, target.image, 1e3))
    seen = stretched.weight > 0
    torch.testing.assert_close(camera.undistorted(view, spoiled, "solid_angle").image[seen], stretched.image[seen])


def test_maps_of_another_size_are_the_same_camera():
    moved = []
    for width in (64, 32):
        camera = CameraMap(64, 32)
        with torch.no_grad():
            camera.focal.copy_(torch.tensor([1.1, 1.0, 1.0]))
        pixels = camera._resized(camera.source_pixels(), width, width // 2)
        moved.append((pixels - CameraMap(width, width // 2)._centers)[0, 0].detach() / width)
    torch.testing.assert_close(*moved, atol=2e-3, rtol=0)


def test_depth_does_not_mix_with_that_of_empty_pixels():
    """Check that one opaque ball in a void has one depth, through both kinds of cameras."""
    turn = torch.tensor([[1.0, 0, 0, 0]])
    ball = Gaussians(torch.tensor([[0.0, 0, 5]]), turn, torch.full((1, 3), 0.5), torch.tensor([0.95]), torch.ones(1, 3))
    view = View("v", torch.eye(4, dtype=torch.float64), W, H)
    ideal = render(ball, view, RenderOptions("ray"))
    camera = distorted().float()
    empty = replace(ideal, image=0 * ideal.image, transmittance=0 * ideal.depth + 1, depth=0 * ideal.depth)
    half = torch.full((H, W), 0.5)
    for rendering in (camera.photographed(ideal), stitched(ideal, empty, half), stitched(empty, ideal, half)):
        drawn = rendering.transmittance < 0.999
        assert drawn.sum() > 20
        torch.testing.assert_close(rendering.depth[drawn], torch.full((int(drawn.sum()),), 5.0), atol=1e-4, rtol=0)


def test_photographs_of_a_learned_camera_survive_storing():
    method = OmniGSMethod(train=TrainOptions(weight="uniform", lens="map"))
    list(method.fit(tiny_scene(), Budget(3)))
    with torch.no_grad():
        method._camera.offsets.copy_(0.3 * rays(32, 16).flip(-1))
    view, ideal = tiny_scene().test[0], method.model.render(tiny_scene().test[0]).image
    again = OmniGSMethod(train=method.train_options)
    again.load_state(method.state())
    assert torch.equal(again.render(view).image, method.render(view).image)
    assert (method.render(view).image - ideal).abs().max() > 0.05


def photographed(gap: float, bending: tuple[float, float]) -> Scene:
    """The tiny scene with its exact centres and colours as points, through two lenses."""
    scene, seen = tiny_scene(), truth()
    scene = replace(scene, points=seen.means, point_colors=(255 * seen.colors).round().to(torch.uint8))
    lenses = DualLens(order=1, scene_scale=scene.scale)
    with torch.no_grad():
        lenses.gap.fill_(gap)
        lenses.coefficients[:, 0] = torch.tensor(bending)

    @torch.no_grad()
    def taken(view: View) -> View:
        pixels = (255 * lenses.draw(drawer(seen), view).rendering.image.clamp(0, 1)).round().to(torch.uint8)
        return replace(view, load_pixels=lambda: pixels)

    return replace(scene, train=tuple(map(taken, scene.train)))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_lenses_are_recovered_and_test_cameras_are_ideal(sign, monkeypatch):
    """With Gaussians that are right from the start and learn next to nothing, all that is wrong is the camera."""
    gap, bending = sign * 0.06, (sign * 0.02, sign * -0.03)
    scene = photographed(gap, bending)
    method = Seam360GSMethod(train=replace(Seam360GSMethod.TRAIN, learning_rates=1e-3))
    monkeypatch.setattr("padgs.training.lenses.LENS_RATE", 5e-3)
    records = method.fit(scene, Budget(60))
    next(records)
    with torch.no_grad():
        method.model.splats.log_scales.copy_(truth().scales.log())
        method.model.splats.opacity_logits.copy_(torch.logit(truth().opacities))
    *_, last = records
    lenses = method._trainer.corrections.lens
    assert lenses.gap.item() == pytest.approx(gap, rel=0.3)  # measured: 13 %
    assert lenses.coefficients.sum(1).tolist() == pytest.approx(bending, rel=0.4), "at 1 rad from the axis"
    assert "lens gap" in last.events[-1]
    image = method.render(scene.test[0]).image
    with torch.no_grad():
        lenses.gap.fill_(1.0)
    assert torch.equal(method.render(scene.test[0]).image, image)


def test_learning_rates_of_the_lenses_fall_to_a_tenth():
    lenses = DualLens()
    ends = {"lens_gap": (1e-3, 1e-4, [lenses.gap]), "lens_coefficients": (1e-3, 1e-4, [lenses.coefficients])}
    assert_log_linear(lenses.groups(400), ends, 400)
