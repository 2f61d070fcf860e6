"""padgs_plus: schedules for any length, independence of units, small Gaussians, dropout."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice

import pytest
import torch
from support.states import assert_same_but_time
from support.tiny_scene import in_other_units, tiny_scene

from padgs import clock
from padgs.geometry.distortion import solid_angle_weight
from padgs.methods.plus.method import (
    AMPLE_PIXELS,
    DENSIFIED_SHARE,
    ROUNDS,
    PlusMethod,
    PlusOptions,
)
from padgs.methods.plus.smoothness import roughness
from padgs.methods.splats.depth_initialization import MIN_PIXELS, solid_angle_pixels
from padgs.methods.splats.importance import count_for_psnr, importance_scores
from padgs.methods.splats.method import SplatMethod
from padgs.scene import Scene
from padgs.training.health import Failure
from padgs.training.loop import Record
from padgs.training.options import Budget, TrainOptions
from padgs.training.targets import halved

OPTIONS = PlusOptions(gradient_threshold=1e-6, initial_per_pixel=None, limit_per_pixel=None, depth_init_per_pixel=0.0)


@pytest.mark.parametrize("iterations", [16, 60, 500, 7000, 30_000])
def test_the_number_of_rounds_does_not_depend_on_the_length(iterations):
    options = PlusOptions().for_run(iterations)
    rounds = [i for i in range(1, iterations + 1) if i < options.densify_until and i % options.densify_every == 0]
    assert len(rounds) == ROUNDS and options.reset_every > iterations
    assert rounds[-1] == pytest.approx(DENSIFIED_SHARE * iterations, abs=ROUNDS / 2)


@pytest.mark.parametrize("points", [40, 20])
@pytest.mark.parametrize("units", [1.0, 100.0])
def test_a_budget_of_gaussians_is_met_for_any_points_and_units(points, units):
    scene = in_other_units(tiny_scene(), units)
    scene = replace(scene, points=scene.points[:points], point_colors=scene.point_colors[:points])
    records = list(PlusMethod(PlusOptions(initial_per_pixel=None)).fit(scene, Budget(64, gaussians=150)))
    assert 135 <= records[-1].counts["gaussians"] <= 150


def test_the_threshold_falls_with_the_length_of_a_run_up_to_2000():
    found = [PlusOptions().for_run(iterations).gradient_threshold for iterations in (125, 500, 2000, 30_000)]
    assert found == pytest.approx([2e-4, 1e-4, 5e-5, 5e-5])


def test_the_threshold_falls_with_the_pixel_width_and_rises_for_few_views():
    def threshold(width):
        scene = tiny_scene()
        views = tuple(replace(view, width=width, height=width // 2) for view in scene.train)
        model = PlusMethod(PlusOptions(depth_init_per_pixel=0.0)).build_model(replace(scene, train=views), 30_000)
        return model.densifier.options.gradient_threshold

    pixels = [2 * w * w / 2 / math.pi for w in (64, 256, 512, 1024)]
    found = [[PlusOptions().for_views(p, views).gradient_threshold for p in pixels] for views in (100, 28, 7, 1)]
    assert found[0] == found[1] == pytest.approx([5e-5, 5e-5, 2.5e-5, 1.25e-5])
    assert found[2] == pytest.approx([5e-5, 5e-5, 5e-5, 2.5e-5])
    assert found[3] == pytest.approx([5e-5, 5e-5, 5e-5, 5e-5]), "few views never ask for less than small ones"
    assert PlusOptions(threshold_pixel_exponent=0.0).for_views(10**6, 28) == PlusOptions(threshold_pixel_exponent=0.0)
    assert PlusOptions(threshold_full_views=0).for_views(pixels[2], 1).gradient_threshold == pytest.approx(2.5e-5)
    few = math.sqrt(28 / len(tiny_scene().train))
    assert [threshold(w) for w in (64, 1024)] == pytest.approx([5e-5, min(1, few / 4) * 5e-5])


def test_the_most_important_gaussians_are_kept():
    trained, tiny = [], tiny_scene()
    for psnr in (None, 44.0):
        method = PlusMethod(replace(OPTIONS, prune_psnr=psnr, dropout=0.0))
        for record in islice(method.fit(tiny, Budget(200)), 9 * PlusOptions().for_run(200).densify_every):
            before = record.counts["gaussians"]
        trained.append(method.model)
        assert method.render(tiny.test[0]).image.isfinite().all(), "at once"
    whole, chosen = (model.splats.means for model in trained)  # pieces of one Gaussian may share a coordinate
    found = importance_scores(trained[0], tiny.train)
    assert len(whole) > before == len(chosen) == count_for_psnr(found, 44.0)
    kept = (whole[:, None] == chosen).all(-1).any(1)
    assert kept.sum() == len(chosen) and found.change[kept].min() >= found.change[~kept].max()


@pytest.mark.parametrize(("iterations", "least"), [(200, 150), (100, 120), (6, 120)])
def test_a_budget_of_gaussians_is_met(iterations, least):
    for record in PlusMethod(OPTIONS).fit(tiny_scene(), Budget(iterations, gaussians=150)):
        last = record.counts["gaussians"]
    assert least <= last <= 150


@pytest.mark.parametrize(("gaussians", "chosen"), [(150, [61]), ("auto", [61]), (None, [])])
def test_a_run_stopped_before_pruning_prunes_at_once_only_for_a_budget(gaussians, chosen):
    budget, whole, again = Budget(200, gaussians=gaussians), PlusMethod(OPTIONS), PlusMethod(OPTIONS)
    counts, events = [], []
    for record in whole.fit(tiny_scene(), budget):
        counts.append(record.counts["gaussians"])
        events += [record.iteration for event in record.events if "least important" in event]
        if record.iteration == 60:
            assert whole.request_stop("asked")
            again.load_state(whole.state())
    assert events == chosen and (counts[60] == counts[-1] < counts[59]) == bool(chosen)
    assert gaussians != 150 or counts[-1] == 150
    list(again.fit(tiny_scene(), budget))
    assert_same_but_time(again.state(), whole.state())


def test_a_tight_budget_leaves_capacity_for_sky_and_densification():
    tiny = tiny_scene()
    points = tiny.points[:1] + 0.1 * torch.randn(400, 3, generator=torch.Generator().manual_seed(0))
    scene = replace(tiny, points=points, point_colors=tiny.point_colors[:1].expand(400, 3))
    method = PlusMethod(OPTIONS)
    method.fit(scene, Budget(200, gaussians=100))
    far = method.model.splats.means.norm(dim=-1) > 2 * points.norm(dim=-1).max()
    assert (~far).sum() == math.ceil(200 / 1.5) and far.sum() > 20
    assert method.start < 200


def test_a_run_of_seconds_rehearses_ends_on_time_and_resumes_bit_identically(monkeypatch):
    def fitted(method: PlusMethod) -> Iterator[Record]:
        ticks = count()
        monkeypatch.setattr(clock.time, "perf_counter", lambda: next(ticks) / 64)  # so each step takes as long
        monkeypatch.setattr(clock.time, "process_time", lambda: 0.0)
        return method.fit(tiny_scene(), Budget(1, seconds=60 / 64))

    torch.manual_seed(5)
    whole = PlusMethod(OPTIONS)
    records = list(fitted(whole))
    assert records[-1].seconds == pytest.approx(60 / 64, rel=0.05) and records[-1].progress == 1
    assert len(records) == 60 - 6, "two steps and both starts count: the clock was read six times"
    assert whole.state().values["schedule"] == round(0.6 * (60 - 5))
    assert records[-1].counts["gaussians"] > records[0].counts["gaussians"]
    torch.manual_seed(5)
    stopped = PlusMethod(OPTIONS)
    first = list(islice(fitted(stopped), 23))
    resumed = PlusMethod(OPTIONS)
    resumed.load_state(stopped.state())
    assert [*first, *fitted(resumed)] == records
    assert_same_but_time(resumed.state(), whole.state())


def test_one_long_iteration_does_not_end_a_run_of_seconds(monkeypatch):
    """One iteration is long when the machine sleeps, or another program has the processor for a while."""
    ticks = count()
    monkeypatch.setattr(clock.time, "perf_counter", lambda: (tick := next(ticks)) / 64 + (15 / 64 if tick > 30 else 0))
    monkeypatch.setattr(clock.time, "process_time", lambda: 0.0)
    records = list(PlusMethod(OPTIONS).fit(tiny_scene(), Budget(1, seconds=60 / 64)))
    assert records[-1].seconds == pytest.approx(60 / 64, rel=0.05) and records[-1].progress == 1


def test_a_limit_of_seconds_does_not_end_the_rehearsal():
    method = PlusMethod(OPTIONS)
    assert not list(method.fit(tiny_scene(), Budget(10, max_seconds=1e-4, seconds=5))), (
        "but the run, which it counts for"
    )


def test_schedule_options_of_3dgs_are_refused():
    for option in ("reset_every", "max_scale"):
        with pytest.raises(ValueError, match=f"{option} is 100, but padgs_plus has densification rounds of its own"):
            PlusOptions(**{option: 100})


def test_solid_angle_pixels():
    tiny = tiny_scene().train[0]
    view = replace(tiny, width=256, height=128)
    weight = solid_angle_weight(128).sum().item() * 256  # 1 at the horizon
    assert solid_angle_pixels(view) == pytest.approx(weight, rel=0.01)
    assert solid_angle_pixels(tiny) == MIN_PIXELS


def test_training_is_invariant_to_world_units():
    losses = []
    for scale in (1.0, 100.0):
        records = list(PlusMethod(OPTIONS).fit(in_other_units(tiny_scene(), scale), Budget(32)))
        losses.append([record.loss for record in records])
        assert records[-1].counts["gaussians"] > records[0].counts["gaussians"]
    assert losses[1] == pytest.approx(losses[0], rel=1e-3)


def test_initial_number_and_limit_are_multiples_of_the_pixels():
    options = replace(
        OPTIONS, initial_per_pixel=0.01, limit_per_pixel=0.03, sky_per_point=0.5, depth_init_per_pixel=0.0
    )
    method = PlusMethod(options)
    counts = [record.counts["gaussians"] for record in method.fit(tiny_scene(), Budget(32))]
    assert 0 <= method.start - 0.01 * MIN_PIXELS <= 0.005 * MIN_PIXELS
    assert max(counts) <= 0.03 * MIN_PIXELS
    assert max(counts) > counts[0]


@pytest.mark.parametrize(
    ("views", "weight"), [(3, 0.3), (8, 0.3), (11, 0.3 * math.log2(16 / 11)), (16, 0.0), (40, 0.0)]
)
def test_the_smoothness_prior_is_for_few_views(views, weight):
    assert replace(OPTIONS, smoothness_weight=0.3).smoothness(views) == pytest.approx(weight)


def test_penalty_is_the_roughness_of_the_render():
    view, method = tiny_scene().train[1], PlusMethod(replace(OPTIONS, smoothness_weight=0.3))
    next(method.fit(tiny_scene(), Budget(10)))
    splats, drawing = method.model.splats, method.model.draw(view)
    near, far = method.model.render_options(view).near, 4 * splats.scene_scale
    rough = roughness(drawing.rendering, view.camera, near=near, far=far).item()
    assert drawing.penalty.item() == pytest.approx(0.3 * rough) and rough > 0
    drawing.penalty.backward()
    assert splats.means.grad.any()


def test_empty_pixels_have_a_finite_penalty_with_near_0():
    near = replace(PlusMethod.RENDER, near=0.0)
    records = list(PlusMethod(replace(OPTIONS, sky_per_point=0.0), near).fit(tiny_scene(), Budget(3)))
    assert len(records) == 3 and all(math.isfinite(record.loss) for record in records)


def test_dropout_rises_as_pixels_per_gaussian_fall():
    options = PlusOptions(dropout=0.2)
    found = [
        options.dropout_share(pixels=1000.0 * AMPLE_PIXELS, gaussians=n) for n in (1, 1000, 1414.2136, 2000, 10**6)
    ]
    assert found == pytest.approx([0, 0, 0.1, 0.2, 0.2], abs=1e-6)
    assert PlusOptions(dropout=0.0).dropout_share(1.0, 1000) == 0


def test_pruning_all_gaussians_fails_as_collapsed():
    with pytest.raises(Failure, match="no Gaussian is left to draw"):
        list(PlusMethod(replace(OPTIONS, min_opacity=0.999)).fit(tiny_scene(), Budget(60)))


def crowded_scene() -> Scene:
    """A scene of 10 000 pixels, as padgs_plus counts them, and 4000 points."""
    tiny = tiny_scene()
    points = tiny.points.repeat(100, 1) + 0.1 * torch.randn(4000, 3, generator=torch.Generator().manual_seed(0))
    return replace(tiny, points=points, point_colors=tiny.point_colors.repeat(100, 1))


@pytest.mark.parametrize(("done", "share"), [(1, 0.25), (17, 0.25), (18, 0.0), (20, 0.0)])
def test_dropout_scales_the_kept_opacities(done, share):
    scene = crowded_scene()
    method, view = PlusMethod(replace(OPTIONS, dropout=0.25)), scene.train[0]
    list(islice(method.fit(scene, Budget(20)), done))
    drawings = [method.model.draw(view) for _ in range(60)]
    drawn = torch.stack([drawing.gaussians.opacities for drawing in drawings])
    whole = method.model.splats.gaussians(view).opacities
    assert (drawn == 0).float().mean().item() == pytest.approx(share, abs=0.01)
    assert torch.allclose(drawn.amax(0), (whole / (1 - share)).clamp(max=1)), "as much is seen on average"
    (gradients,) = torch.autograd.grad(drawings[0].rendering.image.sum(), drawings[0].gaussians.colors)
    gradients = gradients.abs().amax(-1)
    assert gradients[drawn[0] > 0].max() > 0 and not gradients[drawn[0] == 0].any()


def test_a_refinement_drops_nothing():
    scene, trained = crowded_scene(), PlusMethod(replace(OPTIONS, dropout=0.25))
    list(trained.fit(scene, Budget(5)))
    refined = PlusMethod(replace(OPTIONS, dropout=0.25), train=TrainOptions(refine=True))
    refined.warm_start(trained.state())
    list(islice(refined.fit(scene, Budget(20)), 3))
    assert (refined.model.draw(scene.train[0]).gaussians.opacities > 0).all()


@pytest.mark.parametrize("at", [13, 28])
def test_dropout_is_the_same_after_resuming(at):
    scene, whole, resumed = crowded_scene(), PlusMethod(OPTIONS), PlusMethod(OPTIONS)
    for record in whole.fit(scene, Budget(30)):
        if record.iteration == at:
            resumed.load_state(whole.state())
    list(resumed.fit(scene, Budget(30)))
    assert_same_but_time(resumed.state(), whole.state())


def test_sh_degrees_and_learning_rate_of_means():
    method, scene = (
        PlusMethod(replace(OPTIONS, means_rate_factor=3.0, initial_opacity=0.3, initial_scale=0.5)),
        tiny_scene(),
    )
    degrees = {r.iteration: method.model.splats.active_degree for r in method.fit(scene, Budget(100))}
    assert [degrees[i] for i in (8, 9, 18, 19, 100)] == [0, 1, 1, 2, 2]  # as the next iteration will draw
    usual, ours = SplatMethod(), PlusMethod(replace(OPTIONS, initial_opacity=0.3, initial_scale=0.5, sky_per_point=0.0))
    for started in (usual, ours):
        started.fit(scene, Budget(100))
    rates = [{g.name: g.learning_rate(50) for g in m.model.groups()} for m in (usual, method)]
    rates[0]["means"] /= usual.options.extent_of(scene)  # rates of ours are for a length of 1
    assert {name: rate / rates[0][name] for name, rate in rates[1].items()} == pytest.approx(
        dict.fromkeys(rates[0], 1.0) | {"means": 3.0}
    )
    assert torch.allclose(torch.sigmoid(ours.model.splats.opacity_logits), torch.tensor(0.3))
    torch.testing.assert_close(ours.model.splats.log_scales.exp(), 0.5 * usual.model.splats.log_scales.exp())


@pytest.mark.parametrize("darkest", [60, 0])
def test_random_backgrounds_make_all_opaque_but_a_void(darkest):
    lit = [replace(v, load_pixels=lambda v=v: v.load_pixels().clamp(min=darkest)) for v in tiny_scene().train]
    clear = []
    for random_background in (False, True) if darkest else (True,):
        method = PlusMethod(train=replace(PlusMethod.TRAIN, random_background=random_background))
        list(method.fit(replace(tiny_scene(), train=tuple(lit)), Budget(400)))
        clear.append(method.render(lit[0]).transmittance.mean().item())
    assert clear[-1] < 0.2 * clear[0] if darkest else clear[-1] > 0.1, clear


def test_panoramas_of_several_sizes_start_with_one_number_in_any_order():
    first, *others = tiny_scene().train
    views = (halved(first), *others)
    models = [PlusMethod().build_model(replace(tiny_scene(), train=of), 100) for of in (views, views[::-1])]
    small, large = sorted(model.counts()["gaussians"] for model in models)
    assert large < 1.1 * small
