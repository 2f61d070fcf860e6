"""Budgets of Gaussians, for all methods that have some."""

import itertools
from dataclasses import replace

import pytest
import torch
from support.composed import composed
from support.tiny_scene import tiny_scene

from padgs.multirun.composition import make_method
from padgs.training.optimizer import Optimizer
from padgs.training.options import Budget
from padgs.training.schedule import Pace


@pytest.mark.parametrize("name", ["omnigs", "spags", "cubemap_3dgs"])
def test_budget_auto_prunes_once_after_densification(name):
    method = make_method(name, "train.monitor=false")  # a scene this small diverges after it
    counts, events = [], []
    for record in itertools.islice(method.fit(tiny_scene(), Budget(450, gaussians="auto")), 300):
        counts.append(record.counts["gaussians"])
        events += [(record.iteration, event) for event in record.events if "least important" in event]
    ((iteration, event),) = events
    assert iteration == method.model.densifier.options.densify_until + 49
    before, after = counts[iteration - 2], counts[iteration - 1]
    assert event == f"pruned the least important of {before} Gaussians, kept {after}"
    assert after < before


@pytest.mark.parametrize(
    ("settings", "budget"),
    [
        (("method=sc_omnigs",), Budget(120, gaussians="auto")),
        (("method=spags_tuned", "train.poses=learned_fast"), Budget(120)),
        (("method=padgs_plus", "train.poses=learned_fast"), Budget(120)),
    ],
)
def test_pruning_from_poses_that_the_model_leaves_is_refused(settings, budget):
    name, *overrides = settings
    with pytest.raises(ValueError, match="score Gaussians from the given poses; set train.poses=learned"):
        make_method(name.removeprefix("method="), *overrides).refuse_budget(budget)


def test_budget_auto_works_with_learned_exposures():
    method = make_method("omnigs", "train.exposures=learned")
    method.refuse_budget(Budget(120, gaussians="auto"))
    with pytest.raises(ValueError, match="budget.stop is auto"):
        method.refuse_budget(Budget(120, stop="auto"))


TUNED = {
    **{"sh_degree": 2, "initial_per_pixel": 0.6, "depth_init_per_pixel": 0.6, "sky_per_point": 0.5},
    **{"split": "long_axis", "initial_opacity": 0.5, "initial_scale": 0.6},
    **{"means_rate_factor": 2.0, "prune_psnr": 44.0},
}


def test_spags_tuned_has_the_options_of_padgs_plus_that_any_method_could_have():
    names = ("spags_tuned", "spags_supersampled", "spags_complete", "spags_narrow", "padgs_plus")
    tuned, supersampled, complete, narrow, plus = (composed(f"method={name}") for name in names)
    assert tuned.options == replace(narrow.options, **TUNED)
    assert {name: getattr(plus.options, name) for name in TUNED} == TUNED
    assert (tuned.train.weight, tuned.render.low_pass, tuned.render.blending) == ("solid_angle", 0.1, "sorted")
    assert (tuned.train.weight, tuned.render.supersampling) == (plus.train.weight, 1)
    assert supersampled.options == replace(tuned.options, supersampling_from=plus.options.supersampling_from)
    assert supersampled.render == replace(plus.render, near_cull="ellipsoid", steepness=0.0)
    assert supersampled.train == tuned.train
    assert complete.options == replace(supersampled.options, length_unit=plus.options.length_unit)
    assert complete.train == replace(tuned.train, random_background=True)
    assert complete.render == replace(plus.render, near_cull="ellipsoid")


@pytest.mark.parametrize("name", ["omnigs", "odgs", "op43dgs", "cubemap_3dgs", "sc_omnigs"])
def test_every_explicit_method_takes_the_options_of_padgs_plus(name):
    given = "train.poses=given" if name == "sc_omnigs" else "seed=0"
    options = [f"method.{key}={value}" for key, value in {**TUNED, "initial_per_pixel": 0.1}.items()]
    method = make_method(name, *options, given)
    tiny = tiny_scene()
    points = tiny.points[:1] + 0.1 * torch.randn(400, 3, generator=torch.Generator().manual_seed(0))
    scene = replace(tiny, points=points, point_colors=tiny.point_colors.repeat(10, 1))
    method.fit(scene, Budget(450))
    model = method.model
    far = model.splats.means.norm(dim=-1) > 2 * points.norm(dim=-1).max()
    assert method.start == 0.1 * 2000 + far.sum() and far.any(), "points and sky"
    assert torch.allclose(torch.sigmoid(model.splats.opacity_logits), torch.tensor(0.5))
    assert model.pruning.is_ahead(60)
    assert model.splats.sh_rest.shape[1] == 8
    rates = {group.name: group.learning_rate(0) for group in model.groups()}
    assert rates["means"] == pytest.approx(2 * 1.6e-4 * method.options.extent_of(scene))


@pytest.mark.parametrize("gaussians", [None, 100, "auto"])
@pytest.mark.parametrize("name", ["padgs_plus", "spags_tuned"])
def test_nothing_is_pruned_that_training_cannot_recover(name, gaussians):
    method, scene = make_method(name, f"budget.gaussians={gaussians or 'null'}"), tiny_scene()
    for iterations in (60, 150, 170, 181, 182, 200, 300, 416, 417, 1000):
        method.fit(scene, Budget(iterations, gaussians=gaussians))
        step = method.model.pruning
        left = iterations - step.due
        assert step.is_ahead(0) == (left >= max(100, 0.38 * iterations)) == step.is_due(step.due), iterations


@pytest.mark.parametrize(("name", "least"), [("padgs_plus", 5.0), ("spags_tuned", 1.0)])
def test_means_of_padgs_plus_alone_keep_their_pace_in_long_runs(name, least):
    model, pace = make_method(name).build_model(tiny_scene(), 7000), Pace.of("run", 7000)
    published = {group.name: group.learning_rate(1) for group in model.groups()}
    optimizer = Optimizer(model.groups(), check_every=50)
    optimizer.step(1, pace)
    factors = {group["name"]: group["lr"] / published[group["name"]] for group in optimizer.adam.param_groups}
    assert 2 < pace.factor < 5 and factors.pop("means") == pytest.approx(max(least, pace.factor))
    assert [*factors.values()] == pytest.approx([pace.factor] * len(factors)) and factors
