from dataclasses import replace
from itertools import islice

import pytest
import torch
from support.composed import composed
from support.states import assert_same_but_time
from support.tiny_scene import squared_error, tiny_scene

from padgs.baselines.omnigs import OmniGSMethod
from padgs.methods.splats.method import SplatOptions
from padgs.native import cpu
from padgs.render import RenderConfig
from padgs.runs import checkpoint
from padgs.scene import Scene
from padgs.training.health import Failure
from padgs.training.model import State
from padgs.training.options import Budget

ITERATIONS = 120  # densifies at 50, and goes through all degrees


def method(seed: int = 0, backend: str = "torch", **options) -> OmniGSMethod:
    options = {"densify_until": 20_000, "max_gaussians": 60} | options
    train = replace(OmniGSMethod.TRAIN, learning_rates="published")
    return OmniGSMethod(SplatOptions(**options), RenderConfig(backend=backend), train, seed=seed)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return tiny_scene()


@pytest.fixture(scope="module")
def finished(scene) -> State:
    trained = method()
    list(trained.fit(scene, Budget(ITERATIONS)))
    return trained.state()


def test_sixty_iterations_learn_the_scene(scene):
    trained = method()
    records = trained.fit(scene, Budget(60))
    next(records)
    start = squared_error(trained, scene.test[0])
    losses = [record.loss for record in records]
    assert losses[-1] < 0.6 * losses[0]
    assert squared_error(trained, scene.test[0]) < 0.5 * start  # measured: 0.46


def test_counts_are_those_after_the_iteration(scene):
    counts = [record.counts for record in method().fit(scene, Budget(ITERATIONS))]
    assert counts[48] == {"gaussians": 40, "drawn": 40}
    assert counts[49] == {"gaussians": 60, "drawn": 40}
    assert counts[50] == {"gaussians": 60, "drawn": 60}


native = pytest.mark.skipif(not cpu.available(), reason="the native library is not built")


@pytest.mark.parametrize(("stop", "backend"), [(50, "torch"), pytest.param(51, "cpu", marks=native)])
def test_resuming_around_densification_is_bit_identical(scene, tmp_path, stop, backend):
    whole, first, second = (method(backend=backend) for _ in range(3))
    list(whole.fit(scene, Budget(ITERATIONS)))
    records = first.fit(scene, Budget(ITERATIONS))
    for _ in range(stop):
        next(records)
    state = first.state()
    checkpoint.save(state, tmp_path)
    torch.manual_seed(stop)  # another process

    second.load_state(checkpoint.load(tmp_path))
    assert_same_but_time(second.state(), state)
    rest = [record.iteration for record in second.fit(scene, Budget(ITERATIONS))]
    assert rest == list(range(stop + 1, ITERATIONS + 1))
    assert_same_but_time(second.state(), whole.state())


def test_non_finite_parameters_stop_the_run(scene):
    """Renderers leave such a Gaussian out, so the loss stays finite; the next check of all parameters finds it."""
    trained = method()
    list(islice(trained.fit(scene, Budget(60)), 20))
    state = trained.state()
    state.tensors["model/splats/log_scales"][3, 1] = float("nan")
    poisoned = method()
    poisoned.load_state(state)
    with pytest.raises(Failure, match=r"\w+\[3, \d\] is nan at iteration 50") as caught:
        list(poisoned.fit(scene, Budget(60)))
    assert caught.value.status == "nan"


def test_the_release_differs_by_its_deviations_only():
    described, released = (composed(f"method={name}") for name in ("omnigs", "omnigs_release"))
    assert described.render == RenderConfig() and released.render == composed("method=padgs", "render=released").render
    deviations = {"densify_from": 0, "reset_opacity": 1.0, "prune_by_extent_from": 0}
    assert released.options == replace(described.options, **deviations, min_extent=0.0, max_gaussians=None)
    assert described.train == released.train and released.train.weight == "uniform"
    on_roam360 = [composed(f"method={name}", "+scene=roam360_bar") for name in ("omnigs", "omnigs_release")]
    assert [job.options.prune_by_extent for job in on_roam360] == [False, True]


def test_finished_model(finished):
    """40 points have grown to the cap; a Gaussian has 59 numbers."""
    assert finished.values["model"]["active_degree"] == 3
    shown = method()
    shown.load_state(finished)
    size = shown.size()
    assert size.counts == {"gaussians": 60} and size.parameters == 60 * 59 and size.bytes == 60 * 236


def test_state_of_other_options_is_refused(finished):
    with pytest.raises(ValueError, match=r"sh_rest of the stored model has shape \[60, 15, 3\]"):
        method(sh_degree=1).load_state(finished)
