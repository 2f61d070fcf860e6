"""Runs that begin with the model of a finished one: what goes on, what begins anew, and what is refused."""

import shutil
from dataclasses import replace

import pytest
import torch
from rich.console import Console
from support.states import assert_same_but_time
from support.tiny_run import SETTINGS, tiny_run
from support.tiny_scene import tiny_scene

import padgs
from padgs import results
from padgs.baselines import METHODS
from padgs.checks import ConfigError, lookup
from padgs.multirun.composition import composing, configuration
from padgs.runs import checkpoint
from padgs.runs.interrupt import Interrupted
from padgs.runs.run import Callback, load_scene, run
from padgs.runs.store import RunStore
from padgs.training.options import Budget, TrainOptions
from padgs.training.targets import halved

SMALL_GRIDS = {"radial_nodes": 8, "polar_nodes": 8, "azimuth_nodes": 16, "density_components": 2}
SMALL_GRIDS |= {
    "appearance_components": 2,
    "features": 4,
    "hidden": 8,
    "coarse_samples": 8,
    "fine_samples": 8,
    "rays": 64,
}


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tiny_run(tmp_path_factory)


@pytest.fixture(autouse=True)
def scenes(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path_factory.getbasetemp() / "scenes"))


def config(runs, *settings):
    with composing():
        return configuration(["method=omnigs", *SETTINGS, "run.log_every=1", *settings, f"run.folder={runs}"])


def started(runs, *settings, callback=Callback()):  # noqa: B008 - no state
    return run(config(runs, *settings), Console(quiet=True), callback)


def test_it_begins_with_the_model_at_another_width_too(base, tmp_path):
    before, first = results.read(base / "result.json"), next(results.log_lines(base))
    result = started(tmp_path, f"init={base}", "data.width=64")
    assert result.ok and result.counts["start"] == before.counts["gaussians"], result.reason
    assert result.iterations_done == 30 and result.variant == "continued" and result.width == 64
    lines = list(results.log_lines(tmp_path / result.run))
    assert lines[0]["progress"] < 0.1 and lines[0]["loss"] < first["loss"]
    loaded = padgs.load_run(tmp_path / result.run, device="cpu")
    assert loaded.config.init is not None and loaded.config.init.run == str(base), "the file of the run says so"


@pytest.mark.slow
def test_it_is_known_by_the_checkpoint_wherever_that_is(base, tmp_path):
    shutil.copytree(base, tmp_path / "moved")
    names = []
    for more in ((f"init={base}",), (f"init={tmp_path}/moved",), ()):
        composed = config(tmp_path, *more)
        names.append(RunStore.of(composed, load_scene(composed, torch.device("cpu"))).path.name)
    assert names[0] == names[1] != names[2]
    assert "init" not in config(tmp_path).values(), "runs without are called what they were before"


@pytest.mark.slow
def test_an_interrupted_one_goes_on_to_the_same_end(base, tmp_path):
    class Impatient(Callback):
        def __init__(self):
            self.asked = 0

        def stop_requested(self):
            self.asked += 1
            return self.asked > 12

    whole = started(tmp_path / "whole", f"init={base}")
    with pytest.raises(Interrupted):
        started(tmp_path / "parts", f"init={base}", callback=Impatient())
    assert started(tmp_path / "parts", f"init={base}").ok
    assert_same_but_time(*(_without_progress(tmp_path / name / whole.run) for name in ("whole", "parts")))


def _without_progress(folder):
    state = checkpoint.load(folder / "checkpoint")
    return replace(state, values={key: value for key, value in state.values.items() if key != "progress"})


@pytest.mark.parametrize(
    "spoil, settings, message",
    [
        (
            lambda run: shutil.rmtree(run),
            (),
            "is no folder of a run; give a run of which padgs-run has shown the scores",
        ),
        (lambda run: (run / "result.json").unlink(), (), "is not finished"),
        (lambda run: shutil.rmtree(run / "checkpoint"), (), "cannot read .*state.json"),
        (lambda run: _failed(run), (), r"ended with status nan \(why\), so its model is of no use"),
        (lambda run: None, ("method=odgs",), "is a run of omnigs, whose model does not fit odgs; set method=omnigs"),
    ],
)
def test_what_is_no_such_run_is_refused_at_composition(base, tmp_path, spoil, settings, message):
    shutil.copytree(base, tmp_path / "run")
    spoil(tmp_path / "run")
    with pytest.raises(ConfigError, match=message):
        config(tmp_path, f"init={tmp_path}/run", *settings)


def _failed(run):
    results.write(replace(results.read(run / "result.json"), status="nan", reason="why"), run)


@pytest.mark.slow
def test_other_data_and_another_checkpoint_are_refused_before_training(base, tmp_path):
    with pytest.raises(ConfigError, match="trained on other data: .* only data.width may differ"):
        started(tmp_path / "runs", f"init={base}", "data.generator.points=100")
    assert not list((tmp_path / "runs").glob("*/config.yaml"))
    with pytest.raises(ConfigError, match="was trained under stress none, and this run is under .*few_views"):
        started(tmp_path / "runs", f"init={base}", "stress.condition=few_views")
    noisy = ("stress.condition=pose_noise", "stress.level=2")
    first = tmp_path / "runs" / started(tmp_path / "runs", *noisy).run
    with pytest.raises(ConfigError, match="under stress .*'seed': 0}, and this run is under .*'seed': 1}"):
        started(tmp_path / "runs", f"init={first}", *noisy, "seed=1")
    shutil.copytree(base, tmp_path / "run")
    composed = config(tmp_path / "runs", f"init={tmp_path}/run")
    state = checkpoint.load(tmp_path / "run" / "checkpoint")
    state.tensors["model/splats/means"] += 1
    checkpoint.save(state, tmp_path / "run" / "checkpoint")
    with pytest.raises(ConfigError, match="has changed since"):
        run(composed, Console(quiet=True))


def test_a_model_that_does_not_fit_the_options_is_a_rejected_run(base, tmp_path):
    result = started(tmp_path, f"init={base}", "method.sh_degree=1")
    assert result.status == "rejected" and "the model of the warm start does not fit these options" in result.reason


@pytest.mark.parametrize("name", ["padgs", "padgs_plus", "seam360gs", "egonerf", "cubemap_3dgs"])
def test_every_family_begins_with_the_very_model(name):
    scene, kind = tiny_scene(), lookup(METHODS, name, "method")
    options = kind.Options(**(SMALL_GRIDS if name == "egonerf" else {}))
    first, second = kind(options), kind(options)
    list(first.fit(scene, Budget(4)))
    second.warm_start(first.state())
    records = second.fit(scene, Budget(4))
    assert torch.equal(second.render(scene.test[0]).image, first.render(scene.test[0]).image)
    assert [record.iteration for record in records] == [1, 2, 3, 4]
    assert not torch.equal(second.render(scene.test[0]).image, first.render(scene.test[0]).image)


def test_exposures_that_both_learn_are_taken_over():
    scene, learned = tiny_scene(), TrainOptions(weight="uniform", exposures="learned")
    kind = lookup(METHODS, "omnigs", "method")
    first = kind(train=learned)
    list(first.fit(scene, Budget(10)))
    gains = first.state().under("views/")["log_gains.0"]
    for train, expected in ((learned, gains), (TrainOptions(weight="uniform"), None)):
        second = kind(train=train)
        second.warm_start(first.state())
        second.fit(scene, Budget(10))
        taken = second.state().under("views/").get("log_gains.0")
        assert taken is None if expected is None else torch.equal(taken, expected) and expected.any()


def test_learned_poses_are_taken_over_at_another_size_without_the_map_of_the_camera():
    kind = lookup(METHODS, "sc_omnigs", "method")
    first, second = kind(), kind()
    list(first.fit(tiny_scene(), Budget(10)))
    second.warm_start(first.state())
    second.fit(replace(tiny_scene(), train=tuple(map(halved, tiny_scene().train))), Budget(10))
    taken, given = (one.state().under("views/poses.") for one in (second, first))
    assert given["shifts.0"].any() and all(torch.equal(taken[name], given[name]) for name in given)
    assert not second.state().tensors["views/lens.offsets"].any()


@pytest.mark.parametrize("name", ["cubemap_3dgs", "crops_3dgs"])
def test_refinement_draws_as_many_views_an_iteration(name):
    kind = lookup(METHODS, name, "method")
    first, second = kind(), kind(train=replace(kind.TRAIN, refine=True))
    list(first.fit(tiny_scene(), Budget(2)))
    second.warm_start(first.state())
    second.fit(tiny_scene(), Budget(2))
    assert second._trainer._views_each == first._trainer._views_each > 1
