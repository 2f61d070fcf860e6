"""The published schedule of explicit Gaussians, number by number, and what it measures lengths with."""

from dataclasses import replace

import pytest
import torch
from support.composed import composed
from support.rates import assert_log_linear
from support.tiny_scene import tiny_scene
from torch import Tensor

from padgs.baselines.op43dgs import OP43DGSModel, OP43DGSOptions
from padgs.methods.splats.method import SplatMethod, SplatOptions
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import Splats
from padgs.multirun.composition import make_method
from padgs.render import RenderConfig
from padgs.render.projection import low_pass_filtered, low_pass_of
from padgs.render.supersampling import with_smaller_pixels
from padgs.runs.run import build_method
from padgs.scene import Scene, View
from padgs.training.initial_points import ExtentOptions
from padgs.training.options import Budget
from padgs.training.schedule import PUBLISHED_ITERATIONS

EXTENT = 7.0
# group -> learning rates of 3DGS at the start and at the end; that of the means is for an extent of 1
RATES = {
    "means": (1.6e-4, 1.6e-6),
    "quats": (1e-3, 1e-3),
    "log_scales": (5e-3, 5e-3),
    "opacity_logits": (5e-2, 5e-2),
    "sh_dc": (2.5e-3, 2.5e-3),
    "sh_rest": (1.25e-4, 1.25e-4),
}
LENGTHS = {"means": EXTENT}  # what a rate is multiplied by


def trainable(iterations: int = PUBLISHED_ITERATIONS) -> SplatModel:
    splats = Splats.from_scene(tiny_scene(), generator=torch.Generator())
    return SplatModel(splats, SplatOptions(), RenderConfig(), extent=EXTENT, iterations=iterations)


@pytest.mark.parametrize(("step", "samples"), [(0, 1), (50, 2)])
@pytest.mark.parametrize(
    ("kind", "options"), [(SplatModel, SplatOptions()), (OP43DGSModel, OP43DGSOptions(fixed_low_pass=True))]
)
def test_rendered_opacities_are_those_of_the_renderer(kind, options, step, samples):
    view, options = tiny_scene().train[0], replace(options, supersampling_from=0.5)
    splats = Splats.from_scene(tiny_scene(), generator=torch.Generator())
    config = RenderConfig("ray", low_pass=0.3, supersampling=2)
    model = kind(splats, options, config, extent=EXTENT, iterations=100, views=[view])
    model._step = step
    camera = with_smaller_pixels(view.camera, samples)
    gaussians, pose = model.splats.gaussians(view), view.cam_from_world.float()
    means = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    drawn = low_pass_filtered(gaussians, means, low_pass_of(model.render_options(view), camera))
    torch.testing.assert_close(model._rendered_opacities(), drawn.opacities, rtol=1e-4, atol=0)


def travelling(scene: Scene, times: float) -> Scene:
    """All cameras so many times as far apart; the points stay."""
    train = []
    for view in scene.train:
        pose = view.cam_from_world.clone()
        pose[:3, 3] *= times
        train.append(replace(view, cam_from_world=pose))
    return replace(scene, train=tuple(train))


def in_one_place(scene: Scene, rounding: float) -> Scene:
    """All cameras at the first one's place, up to `rounding` world units."""
    train = []
    for number, view in enumerate(scene.train):
        pose = scene.train[0].cam_from_world.clone()
        pose[0, 3] += rounding * number
        train.append(replace(view, cam_from_world=pose))
    return replace(scene, train=tuple(train))


@pytest.mark.parametrize("iterations", [PUBLISHED_ITERATIONS, 600])
def test_published_learning_rates(iterations):
    model = trainable(iterations)
    groups = {group.name: group for group in model.groups()}
    assert groups.keys() == RATES.keys()
    rows, ends = model.splats.rows(), {}
    for name, (first, last) in RATES.items():
        times = LENGTHS.get(name, 1.0)
        ends[name] = (times * first, times * last, [rows[name]])
    assert_log_linear(groups.values(), ends, iterations)


def test_adam_is_that_of_3dgs():
    method = SplatMethod(render=RenderConfig(backend="torch"))
    next(method.fit(tiny_scene(), Budget(10)))
    for settings in method._trainer._optimizer.adam.param_groups:
        assert (settings["betas"], settings["eps"], settings["weight_decay"]) == ((0.9, 0.999), 1e-15, 0)


@pytest.mark.parametrize(("iterations", "every"), [(PUBLISHED_ITERATIONS, 1000), (3000, 100), (60, 2)])
def test_a_degree_comes_into_use_every_thousand_published_iterations(iterations, every):
    """Iteration -> degree that it is drawn with, where that is another one than before."""
    model = trainable(iterations)
    optimizer = torch.optim.Adam(model.splats.parameters())
    rises, degree = {}, model.splats.active_degree
    for iteration in range(1, 4 * every + 1):
        if model.splats.active_degree > degree:
            degree = rises[iteration] = model.splats.active_degree
        model.adapt(iteration, optimizer)
    assert rises == {every: 1, 2 * every: 2, 3 * every: 3}


@pytest.mark.parametrize("apart", [0.0, 1e-8, 0.5, 2.0, 5.0])
def test_the_extent_is_of_the_cameras_but_at_least_a_tenth_of_the_scene_scale(apart):
    scene = travelling(tiny_scene(), apart)
    centers = torch.stack([view.center for view in scene.train])
    extent = 1.1 * (centers - centers.mean(0)).norm(dim=-1).max().item()
    assert (0.15 < extent / scene.scale < 0.9) == (apart > 1)
    assert ExtentOptions(0.1).extent_of(scene) == pytest.approx(max(extent, 0.1 * scene.scale))
    assert apart < 1 or scene.extent == pytest.approx(extent)


@pytest.mark.parametrize("release", ["padgs_release", "omnigs_release", "odgs_release", "op43dgs_release"])
def test_releases_measure_with_the_extent_of_their_cameras_however_little_they_move(release, monkeypatch, root):
    """The rate of the means or offsets falls from a published share of it; in one place they could not learn."""
    monkeypatch.setenv("PADGS_ROOT", str(root))
    config, scene = composed(f"method={release}"), travelling(tiny_scene(), 0.1)
    assert 0 < scene.extent < 0.05 * scene.scale
    method = build_method(config)
    method.fit(scene, Budget(1))
    published = 0.01 if release == "padgs_release" else 1.6e-4
    assert method.model.groups()[0].learning_rate(0) == pytest.approx(published * scene.extent, rel=1e-6)
    with pytest.raises(ValueError, match=r"stand in one place, so their extent is 0 .* set method\.min_extent to a"):
        build_method(config).fit(travelling(scene, 0.0), Budget(1))


def test_the_least_that_counts_as_a_move():
    """Around a millionth of the unit: below it is rounding, above it travel."""
    scene = tiny_scene()
    for times, still in ((0.3, True), (3.0, False)):
        moved = in_one_place(scene, times * 1e-6 * scene.scale / 2.2)  # the extent of steps 0 to 4 is 2.2 of them
        assert moved.has_single_center == still


@pytest.mark.parametrize(
    "scene", [travelling(tiny_scene(), 3.0), travelling(tiny_scene(), 0.0)], ids=["moving", "still"]
)
def test_a_method_trains_means_at_the_rate_of_its_scene(scene):
    method = SplatMethod(render=RenderConfig(backend="torch"))
    next(method.fit(scene, Budget(10)))
    means = next(group for group in method.model.groups() if group.name == "means")
    extent = ExtentOptions(0.1).extent_of(scene)
    assert means.learning_rate(0) == pytest.approx(1.6e-4 * extent)
    assert method.model.densifier.extent == extent


def test_renders_have_more_samples_late_in_the_run():
    """One sample a pixel before the given share, as training has; `supersampling` from then on and in the end."""
    scene = tiny_scene()
    view = scene.train[0]

    def model_with(supersampling: int, share: float) -> SplatModel:
        splats = Splats.from_scene(scene, generator=torch.Generator())
        config = RenderConfig(projection="ray", supersampling=supersampling)
        options = SplatOptions(densify_from=1000, supersampling_from=share)
        return SplatModel(splats, options, config, extent=EXTENT, iterations=10)

    model, optimizer = model_with(2, 0.6), torch.optim.Adam([torch.zeros(1, requires_grad=True)])
    one, four = (model_with(times, 0.0).render(view).image for times in (1, 2))
    assert (one - four).abs().max() > 1e-3
    for step in range(10):
        drawn = model.draw(view).rendering.image
        torch.testing.assert_close(drawn, one if step < 6 else four)
        assert model.render_options(view).supersampling == (1 if step < 6 else 2)
        torch.testing.assert_close(model.render(view).image, drawn)
        resumed = model_with(2, 0.6)
        resumed.load_state(model.state())
        torch.testing.assert_close(resumed.draw(view).rendering.image, drawn, rtol=0, atol=0)
        refined = model_with(2, 0.6)
        refined.load_model(model.state())
        torch.testing.assert_close(refined.draw(view).rendering.image, four)
        model.adapt(step + 1, optimizer)


def test_a_start_of_several_samples_without_them_is_refused():
    with pytest.raises(ValueError, match=r"supersampling_from is 0\.5, but render\.supersampling is 1; set render"):
        build_method(composed("method=spags_sorted", "method.supersampling_from=0.5"))
    build_method(composed("method=padgs_plus", "render.supersampling=1"))  # the share of padgs_plus is its own default


@pytest.mark.parametrize("iterations", [10, 1200])
def test_padgs_plus_has_several_samples_in_the_last_three_tenths_of_any_run(iterations):
    scene = tiny_scene()
    model = make_method("padgs_plus", "method.depth_init_per_pixel=0").build_model(scene, iterations)
    for share, expected in {0.0: 1, 0.6: 1, 0.7: 2, 1.0: 2}.items():
        model._step = round(share * iterations)
        assert model.render_options(scene.train[0]).supersampling == expected


def gradients(model: SplatModel, view: View) -> dict[str, Tensor]:
    """Return the gradients of all parameters in the next iteration, which the model observes."""
    drawing = model.draw(view)
    loss = drawing.rendering.image.square().sum()
    (loss if drawing.penalty is None else loss + drawing.penalty).backward()
    model.observe(drawing, model._step + 1)
    assert drawing.mean_offsets.requires_grad == bool(model.densifier.statistics["seen"].any())
    return {name: row.grad for name, row in model.splats.rows().items()}


@pytest.mark.parametrize("name", ["omnigs", "odgs", "op43dgs", "spags", "padgs_plus"])
def test_after_densification_the_same_gradients_come_without_those_of_offsets(name):
    scene, found, seen = tiny_scene(), [], []
    for more in (0, 1):
        model = make_method(name, "method.depth_init_per_pixel=0").build_model(scene, 400)
        options, model.splats.active_degree = model.densifier.options, model.splats.degree
        scales = model.splats.log_scales.data
        scales += 0.3 * torch.randn(scales.shape, generator=torch.Generator().manual_seed(0))
        model._step = options.densify_until - 1
        model.densifier.options = replace(options, densify_until=options.densify_until + more)
        found.append(gradients(model, scene.train[0]))
        seen.append(int(model.densifier.statistics["seen"].sum()))
    assert seen[0] == 0 < seen[1]
    assert all(torch.equal(gradient, found[1][row]) for row, gradient in found[0].items())
    assert all(gradient.any() for gradient in found[0].values())


def test_a_warm_start_observes_its_first_iteration_like_any_other():
    scene, trained, started = tiny_scene(), SplatMethod(), SplatMethod()
    next(trained.fit(scene, Budget(400)))
    started.warm_start(trained.state())
    next(started.fit(scene, Budget(400)))
    assert started.model.densifier.statistics["seen"].max() == 1
