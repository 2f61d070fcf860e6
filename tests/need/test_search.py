"""A whole search on a tiny run: interrupted anywhere it ends the same, and what it leaves is a run."""

import json
import shutil
from dataclasses import replace

import pytest
import torch
from rich.console import Console
from states import assert_same_but_time
from typer.testing import CliRunner

import padgs
from padgs.checks import ConfigError
from padgs.cli.commands import app
from padgs.data.perturb import StressOptions
from padgs.methods.splats.importance import importance_scores, most_important
from padgs.multirun import job
from padgs.multirun.composition import composing, configuration
from padgs.need import tiers
from padgs.need.outcome import keep, need
from padgs.need.plan import Plan, smallest
from padgs.need.search import WITHOUT_PERCEPTION, Search
from padgs.need.summary import show
from padgs.results import read
from padgs.runs.checkpoint import CheckpointError
from padgs.runs.interrupt import Interrupt, Interrupted
from padgs.runs.run import Callback
from padgs.training.loop import Trainer
from padgs.training.model import State

METHODS = ("method=omnigs", "method=padgs")


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Two losses are enough to look for, and few sizes."""
    monkeypatch.setattr("padgs.need.plan.plan.__defaults__", ((0.1, 1.0),))
    monkeypatch.setattr("padgs.need.plan.FEWEST_ROWS", 130)
    monkeypatch.setattr("padgs.need.search.RULES", WITHOUT_PERCEPTION)


def state_of(search: Search, number: int) -> State:
    return search.folder.state(number)


SLOW = [pytest.param(method, marks=pytest.mark.slow) for method in METHODS[:1]]  # explicit ones take 16 s


@pytest.mark.parametrize("method", [*SLOW, *METHODS[1:]])
def test_a_search_interrupted_everywhere_ends_as_if_nothing_had_happened(opened, method, tmp_path, monkeypatch):
    whole = Search(opened(method))
    whole.complete(1.0)
    assert len(whole.steps) >= 3 and whole.row == ("anchors" if method == "method=padgs" else "gaussians")
    shutil.rmtree(whole.folder.path)

    class Impatient(Interrupt):
        """Asks to stop at every third look."""

        looks = 0

        @property
        def requested(self) -> bool:
            Impatient.looks += 1
            return Impatient.looks % 3 == 0

    monkeypatch.setattr("padgs.need.search.Interrupt", Impatient)
    stops, within = 0, 0
    while True:
        again = Search(opened(method))
        try:
            again.complete(1.0)
            break
        except Interrupted as interrupted:
            stops += 1
            within += "within" in str(interrupted)
    assert stops > 3 and within > 1
    assert len(again.steps) == len(whole.steps)
    for number, (one, other) in enumerate(zip(whole.steps, again.steps, strict=True)):
        assert one.marks == other.marks and one.rows == other.rows, number
    assert not (again.folder.path / "begun").exists()


@pytest.fixture
def started(opened) -> Search:
    """A search with its first step."""
    search = Search(opened("method=omnigs"))
    step, model = search._make(Plan("waste", None), Interrupt())
    search.folder.add(0, step, model)
    search.steps.append(step)
    return search


def test_an_interrupted_refinement_goes_on_in_its_own_plan_alone_and_all_of_its_time_counts(started):
    rows = started.steps[0].rows
    one, other = Plan("prune", 0, rows - 10), Plan("prune", 0, rows - 20)
    with pytest.raises(Interrupted, match="stopped within a refinement"):
        started._make(one, Interrupt(lambda: True))
    what = f"step 1: {one}"
    begun = started.folder.begun(what)
    assert begun is not None and begun.values["iteration"] == 1
    times = {"seconds": 1000.0, "cpu_seconds": 500.0}
    started.folder.begin(what, State(begun.tensors, begun.values | times))
    step, _ = started._make(other, Interrupt())
    assert step.rows == rows - 20 and step.seconds < 1000
    step, _ = started._make(one, Interrupt())
    assert step.rows == rows - 10 and step.seconds > 1000 and step.cpu_seconds > 500


def test_a_refinement_trains_as_the_run_did_under_its_stress_and_no_sign_ends_it(started, monkeypatch):
    seen = []

    class Noted(Trainer):
        """Tells its options."""

        def __init__(self, trainee, scene, budget, options, seed):
            seen.append(options)
            super().__init__(trainee, scene, budget, options, seed)

    monkeypatch.setattr("padgs.need.search.Trainer", Noted)
    config = replace(started.run.config, stress=StressOptions("learning_rates", 2))
    started.run.config = config
    started._make(Plan("control", 0), Interrupt())
    (options,) = seen
    assert options.learning_rates == config.training.learning_rates != config.train.learning_rates
    assert not options.monitor


@pytest.mark.parametrize("method", METHODS)
def test_the_pruned_model_is_a_run_that_opens_and_has_the_whole_front(opened, method):
    run = opened(method)
    before = run.method.state()
    search = Search(run)
    result = keep(search, 1.0)
    assert_same_but_time(run.method.state(), before)
    pruned = padgs.load_run(run.folder.with_name(result.run), device="cpu")
    number = search.complete(1.0)
    kept = search.steps[number]
    assert next(iter(pruned.method.size().counts.values())) == kept.rows < search.rows
    assert kept.rows == search.steps[smallest(search.steps, 1.0)].rows
    assert pruned.result == result and result.need.items() >= json.loads(json.dumps(need(search))).items()
    assert result.model_bytes == kept.bytes and pruned.config.variant == "need 1 dB"
    assert result.timing["train_seconds"] > run.result.timing["train_seconds"] + result.need["seconds"]
    of_another_loss = replace(search.steps[0], kind="degree", parent=0)
    search.folder.add(len(search.steps), of_another_loss, search.model_of(0).state())
    again = Search(opened(method))
    assert len(again.steps) == len(search.steps) + 1
    assert keep(again, 1.0) == result, "what was kept before stays"
    assert_same_but_time(again.kept(number)[0].state(), pruned.method.model.state())
    with (console := Console(width=200)).capture() as shown:
        show(result.need, console)
    assert "kept for 1 dB" in shown.get()
    assert pruned.score("sphere").metrics == pytest.approx(pruned.scores["sphere"].metrics, nan_ok=True)
    told = result.need
    assert [step["kind"] for step in told["steps"]][:3] == ["waste", "control", "prune"]
    assert told["needs"]["1"] is not None and told["steps"][0]["loss"] == 0


@pytest.mark.parametrize("method", METHODS)
def test_waste_is_what_no_training_view_shows(opened, method):
    run = opened(method)
    model, views = run.method.resumed(run.scene, 60), run.scene.train
    found = importance_scores(model, views)
    pictures = [model.render(view).image for view in views]
    rows = int((found.peak > 0).sum())
    model.keep(found.peak > 0)
    assert next(iter(model.counts().values())) == rows
    for view, picture in zip(views, pictures, strict=True):
        # Who would have left less than 1e-4 stops a pixel without being drawn; then others may be.
        assert torch.allclose(model.render(view).image, picture, atol=1e-2)
    assert (found.change >= 0).all() and found.views.max() <= len(views) and found.blended >= rows


def test_the_rows_that_are_kept_are_those_whose_removal_changes_most(opened):
    run = opened("method=omnigs")
    model = run.method.resumed(run.scene, 60)
    found = importance_scores(model, run.scene.train[:2])
    kept = most_important(found, 20)
    assert len(kept) == 20 and found.change[kept].min() >= found.change.sort(descending=True).values[20]
    assert torch.equal(kept, kept.sort().values)
    with pytest.raises(ValueError, match="no views"):
        importance_scores(model, ())


def test_steps_of_another_model_are_refused(opened):
    search = Search(opened("method=omnigs"))
    search.complete(1.0)
    search.folder._of = "another"
    with pytest.raises(CheckpointError, match="is of another model than the run has now; delete"):
        search.folder.steps()


def test_ctrl_c_says_what_is_safe(opened, monkeypatch):
    monkeypatch.setattr(Interrupt, "requested", True)
    result = CliRunner().invoke(app, ["need", str(opened("method=omnigs").folder)])
    assert result.exit_code == 130 and "stopped after step 1; nothing is lost" in result.output


def refused(*arguments: str) -> str:
    result = CliRunner().invoke(app, ["need", *map(str, arguments)])
    assert result.exit_code == 1, result.output
    return result.stderr


def test_what_cannot_be_searched_is_refused_with_a_way_out(opened, tmp_path):
    run = opened("method=omnigs")
    assert "has no config.yaml; give the folder of one run" in refused(tmp_path)
    assert "--epsilon is 0; it must be > 0: 0.05, 0.1" in refused(run.folder, "--epsilon", "0")
    assert "is none of those that are searched for: 0.05" in refused(run.folder, "--epsilon", "0.3")
    moved = refused(run.folder, "--data", str(tmp_path / "gone"))
    assert f"it is the data of {run.folder}: if it has moved" in " ".join(moved.split())
    (run.folder / "result.json").rename(run.folder / "elsewhere")
    assert "is not finished" in refused(run.folder)
    shutil.rmtree(run.folder / "checkpoint")
    assert "has no checkpoint" in refused(run.folder)


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        (("method=egonerf_small",), "egonerf has no Gaussians that could be left out"),
        (("method=sc_omnigs",), "cameras learn along here"),
        (("train.exposures=learned",), "exposures or cameras learn along here"),
        (("need=yes",), "known: off, on"),
    ],
)
def test_runs_without_gaussians_or_known_cameras_are_refused_before_they_start(settings, why):
    with composing(), pytest.raises(ConfigError, match=why):
        configuration(["need=on", *settings])


def test_runs_with_too_few_views_are_refused(opened):
    folder = opened("method=omnigs", "data.generator.train_views=5", "train.iterations=2").folder
    assert "5 training views leave no calibration views" in refused(folder)


def test_a_need_changes_nothing_of_the_run_and_is_told_at_its_end(settings, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path / "cache"))
    settings = (*settings, "method=omnigs", "need=on", f"run.folder={tmp_path}")
    with composing():
        config = configuration(settings)
        assert config.values() == configuration([*settings, "need=off"]).values()
    result = job.done(config, Console(width=400), Callback())
    told = capsys.readouterr().out
    assert "0.1 dB" in told and f"{result.run}_need-0.1" in told
    kept = read(tmp_path / f"{result.run}_need-0.1" / "result.json")
    assert kept.need["needs"]["0.1"] is not None and kept.experiments == ("need",) and not result.need


@pytest.mark.slow
def test_the_lowest_degree_that_is_good_enough_is_kept(opened, monkeypatch):
    run = opened("method=omnigs")
    monkeypatch.setattr("padgs.need.plan.objections", lambda candidate, reference, epsilon: ())
    search = Search(run)
    result = keep(search, 1.0)
    smallest_degree = search.steps[search.complete(1.0)]
    assert smallest_degree.degree == 0 and result.config["method"]["sh_degree"] == 0
    pruned = padgs.load_run(run.folder.with_name(result.run), device="cpu")
    assert pruned.method.model.splats.sh_rest.shape[1] == 0 and pruned.result == result
    assert [step["degree"] for step in result.need["degrees"]["1"]] == [3, 2, 1, 0]


def test_the_smallest_good_file_stays_and_shows_what_is_said_of_it(opened):
    folder = opened("method=padgs").folder
    run = padgs.load_run(folder.rename(folder.with_name("my room")), device="cpu")
    search = Search(run)
    result = keep(search, 1.0)
    assert result.run == f"{run.result.run}_need-1", "and is not called as the folder is"
    (file,) = (file for file in result.need["files"] if file["kept"])
    exact, half, byte = result.need["files"][:3]
    assert byte["bytes"] < half["bytes"] < exact["bytes"] and exact["loss"] == 0
    folder = run.folder.with_name(result.run)
    assert [path.name for path in folder.glob("model.*")] == [file["file"]]
    model = padgs.load_run(folder, device="cpu").method.model
    tiers.read(folder / file["file"], tiers.model_of(model))
    assert search.scored(model)[1]["ws_psnr"] == pytest.approx(file["test_ws_psnr"], abs=1e-6)
    assert (folder / file["file"]).stat().st_size == file["bytes"]
