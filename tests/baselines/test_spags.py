"""SPaGS: what sets it apart. Order along the ray, bounds that lose nothing and the cull are tested in tests/render."""

import math

import pytest
import torch
from support.composed import composed
from support.tiny_scene import tiny_scene

from padgs.baselines import METHODS
from padgs.baselines.spags import SPaGSMethod, SPaGSOptions
from padgs.checks import lookup
from padgs.gaussians import Gaussians, rotation_matrices
from padgs.geometry.camera import Panorama
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import Splats
from padgs.native import cpu
from padgs.native.abi import Inputs, pointer
from padgs.render import RenderConfig, RenderOptions
from padgs.render.backends.cpu import Projected
from padgs.render.backends.native import native_camera
from padgs.scene import Scene
from padgs.training.health import Failure
from padgs.training.model import Refined

WIDTH, HEIGHT = 2048, 1024
OPTIONS = SPaGSMethod.RENDER.options(scene_scale=1.0)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return tiny_scene()


def test_is_registered_and_configured():
    assert lookup(METHODS, "spags", "method") is SPaGSMethod
    for name, blending in (("spags", "hybrid"), ("spags_sorted", "sorted")):
        config = composed(f"method={name}")
        assert (config.method, config.options) == ("spags", SPaGSOptions())
        assert config.render == RenderConfig(**{**vars(SPaGSMethod.RENDER), "blending": blending})
        assert config.train.weight == SPaGSMethod.TRAIN.weight
    assert (OPTIONS.core_size, OPTIONS.projection, OPTIONS.near_cull) == (16, "ray", "ellipsoid")


def test_the_published_schedule():
    options = SPaGSOptions()
    assert (options.densify_from, options.densify_until, options.densify_every) == (200, 15_000, 100)
    assert (options.positional_gradient, options.gradient_threshold, options.min_opacity) == (
        "space_absolute",
        5e-5,
        0.005,
    )
    assert (options.reset_every, options.reset_opacity, options.opacity_decay) == (3000, 0.1, 0.001)
    assert options.smoothing_filter == 0.2
    assert not options.prune_by_extent and options.sh_degree == 3


def model_of(scene: Scene, iterations: int = 100) -> SplatModel:
    splats = Splats.from_scene(scene, generator=torch.Generator().manual_seed(0))
    options, render = SPaGSOptions(), SPaGSMethod.RENDER
    return SplatModel(splats, options, render, extent=1.0, iterations=iterations, views=scene.train)


def test_the_smoothing_filter_is_a_fifth_of_a_square_pixel_of_the_nearest_training_view(scene):
    """Sigma' = Sigma + 0.2 (r / f)^2 I with f = W / 2 pi, o' = o sqrt(det Sigma / det Sigma'), without a derivative."""
    model = model_of(scene)
    splats, views = model.splats, (scene.train[0], scene.test[0])
    centers = torch.stack([view.center for view in scene.train]).float()
    nearest = torch.cdist(splats.means, centers).amin(-1)
    assert len({*torch.cdist(splats.means, centers).argmin(-1).tolist()}) > 1
    added = 0.2 * (nearest * 2 * math.pi / scene.train[0].width) ** 2
    for view in views:
        drawn = model.draw(view).gaussians
        torch.testing.assert_close(drawn.scales**2 - splats.log_scales.exp() ** 2, added[:, None].expand(-1, 3))
        mass = torch.sigmoid(splats.opacity_logits) * splats.log_scales.exp().prod(-1)
        torch.testing.assert_close(drawn.opacities * drawn.scales.prod(-1), mass)
        assert model.parts(view).options.low_pass == 0, "there is no filter of the view beside it"
    drawn.scales.sum().backward()
    assert (splats.means.grad is None or not splats.means.grad.any()) and splats.log_scales.grad.abs().min() > 0


@pytest.mark.parametrize("refines", [False, True])
def test_the_smoothing_filter_is_updated_once_a_round(refines, scene):
    model = model_of(scene, iterations=3000)
    trained = Refined(model, "published", 3000) if refines else model
    optimizer, view = torch.optim.Adam(model.splats.parameters()), scene.train[0]

    def added() -> torch.Tensor:
        return model.draw(view).gaussians.scales ** 2 - model.splats.log_scales.exp() ** 2

    before = added()
    model.splats.means.data *= 3
    trained.adapt(1, optimizer)
    torch.testing.assert_close(added(), before, atol=1e-7, rtol=1e-3)
    every = model.densifier.options.densify_every
    trained.adapt(every, optimizer)
    after = added()
    assert not torch.allclose(after, before, rtol=0.1)
    model.keep(torch.arange(5))
    torch.testing.assert_close(added(), after[:5])


def test_invisible_gaussians_are_pruned_at_the_end(scene):
    model = model_of(scene, iterations=100)
    model.splats.opacity_logits.data[::2] = torch.logit(torch.tensor(0.006))
    model.splats.log_scales.data[::2] = math.log(1e-3)
    image, count = model.render(scene.test[0]).image, len(model.splats)
    events = model.adapt(100, torch.optim.Adam(model.splats.parameters()))
    left_out = count - len(model.splats)
    assert 0 < left_out <= (count + 1) // 2 and any(
        f"pruned {left_out} invisible Gaussians" in event for event in events
    )
    assert torch.equal(model.render(scene.test[0]).image, image)
    model.splats.opacity_logits.data.fill_(-9.0)
    with pytest.raises(Failure, match="all .* Gaussians are invisible"):
        model.adapt(100, torch.optim.Adam(model.splats.parameters()))


def test_boxes_are_tight_and_published_boxes_are_not(generator):
    """Widths in longitude over the true ones: 1 for ours, 1.20 (median) and 1.56 (95 %) as published."""
    count = 400
    radius = 1 + 3 * torch.rand(count, generator=generator, dtype=torch.float64)
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    scales = 0.15 * radius[:, None] * torch.exp(0.7 * torch.randn(count, 3, generator=generator, dtype=torch.float64))
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    gaussians = Gaussians(radius[:, None] * normal, quats, scales, torch.full((count,), 0.5).double(), normal)
    spread = math.sqrt(2 * math.log(255 * 0.5)) * rotation_matrices(quats) * scales[:, None]
    free = axis_distance(gaussians.means, spread) > 0.2  # of the poles, where all longitudes are right
    free &= ((spread.mT @ normal[..., None]) ** 2).sum((-1, -2)) < radius**2  # in front of the camera's plane
    true = longitude_width(gaussians.means, spread, generator)
    boxes = native_boxes(gaussians)
    ours = ((boxes[:, 1] - boxes[:, 0]) + boxes[:, 2]) * (2 * math.pi / WIDTH)
    published = tangent_corner_width(gaussians.means, spread)
    free &= published > 0  # else it holds the pole for covered, and takes all longitudes
    ratio, pixel = (ours / true)[free], (2 * math.pi / WIDTH / true)[free]
    assert free.sum() > 200
    assert (ratio > 1 - 1.01 * pixel - 0.01).all() and (ratio < 1 + 2 * pixel + 0.02).all()
    median, wide = (published / true)[free].quantile(torch.tensor([0.5, 0.95], dtype=torch.float64))
    assert median.item() == pytest.approx(1.20, abs=0.05) and wide.item() == pytest.approx(1.56, abs=0.12)


def axis_distance(means, spread):
    """How far the vertical axis stays outside each ellipsoid: smallest q along it over k, minus 1."""
    inverse = torch.linalg.inv(spread)
    axis = inverse @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    o = (inverse @ means[..., None])[..., 0]
    along = (o * axis).sum(-1, keepdim=True) / (axis * axis).sum(-1, keepdim=True)
    return ((o - along * axis) ** 2).sum(-1) - 1


def longitude_width(means, spread, generator):
    """Radians from the westmost to the eastmost point of each ellipsoid's surface, sampled."""
    sphere = torch.nn.functional.normalize(torch.randn(20_000, 3, generator=generator, dtype=torch.float64), dim=-1)
    points = means[:, None] + sphere @ spread.mT
    turned = points[..., 0] * means[:, None, 2] - points[..., 2] * means[:, None, 0]
    ahead = points[..., 0] * means[:, None, 0] + points[..., 2] * means[:, None, 2]
    offset = torch.atan2(turned, ahead)
    return offset.amax(-1) - offset.amin(-1)


def tangent_corner_width(means, spread):
    """The published way: box on the tangent plane, then the longitudes of its corners nearer to the pole."""
    radius = means.norm(dim=-1)
    n = means / radius[:, None]
    c, s = (n[:, 0] ** 2 + n[:, 2] ** 2).sqrt(), n[:, 1]
    east = torch.stack((n[:, 2], torch.zeros_like(c), -n[:, 0]), -1) / c[:, None]
    down = torch.stack((-s * n[:, 0] / c, c, -s * n[:, 2] / c), -1)
    dual = spread @ spread.mT - means[:, :, None] * means[:, None]

    def form(a, b):
        return torch.einsum("ni,nij,nj->n", a, dual, b)

    def ratios(a):
        root = torch.sqrt(form(a, n) ** 2 - form(a, a) * form(n, n))
        return (form(a, n) + root) / form(n, n), (form(a, n) - root) / form(n, n)

    (x0, x1), (y0, y1) = ratios(east), ratios(down)
    nearer = torch.where(s > 0, y1, y0)
    return torch.atan2(x1, c - s * nearer) - torch.atan2(x0, c - s * nearer)


def native_boxes(gaussians):
    if not cpu.available():
        pytest.skip("the native library is not built")
    inputs = [getattr(gaussians, n).float().contiguous() for n in ("means", "quats", "scales", "opacities", "colors")]
    structure = Inputs(len(gaussians), *map(pointer, inputs), None)
    options = RenderOptions(projection="ray", low_pass=0.0)
    return Projected(native_camera(torch.eye(4), Panorama(WIDTH, HEIGHT), options), structure, 1 << 26).boxes.double()
