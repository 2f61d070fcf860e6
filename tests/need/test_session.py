"""A whole search on a tiny run: interrupted anywhere it ends the same, and what it leaves is a run."""

import json
import shutil

import pytest
import torch
from states import assert_same_but_time
from typer.testing import CliRunner

import padgs
from padgs.cli.commands import app
from padgs.learning.trainee import State
from padgs.need import session
from padgs.need.outcome import keep, need
from padgs.need.search import smallest
from padgs.need.session import Search
from padgs.need.worth import most_wanted, worth
from padgs.runs.checkpoint import CheckpointError
from padgs.runs.interrupt import Interrupted

METHODS = ("method=omnigs", "method=padgs")


@pytest.fixture(autouse=True)
def short(monkeypatch):
    """Two losses are enough to look for, and few sizes."""
    monkeypatch.setattr("padgs.need.search.plan.__defaults__", ((0.1, 1.0),))
    monkeypatch.setattr("padgs.need.search.FEWEST_ROWS", 130)
    monkeypatch.setattr(session, "RULES", session.WITHOUT_PERCEPTION)


def state_of(search: Search, number: int) -> State:
    return search.folder.state(number)


SLOW = [pytest.param(method, marks=pytest.mark.slow) for method in METHODS[:1]]  # explicit ones take 16 s


@pytest.mark.parametrize("method", [*SLOW, *METHODS[1:]])
def test_a_search_interrupted_everywhere_ends_as_if_nothing_had_happened(opened, method, tmp_path, monkeypatch):
    whole = Search(opened(method))
    whole.complete(1.0)
    assert len(whole.steps) >= 3 and whole.row == ("anchors" if method == "method=padgs" else "gaussians")
    shutil.rmtree(whole.folder.path)

    class Impatient(session.Interrupt):
        """Asks to stop at every third look."""

        looks = 0

        @property
        def requested(self) -> bool:
            Impatient.looks += 1
            return Impatient.looks % 3 == 0

    monkeypatch.setattr(session, "Interrupt", Impatient)
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


@pytest.mark.parametrize("method", METHODS)
def test_the_pruned_model_is_a_run_that_opens_and_has_the_whole_front(opened, method):
    run = opened(method)
    before = run.method.state()
    search = Search(run)
    result = keep(search, 1.0)
    assert_same_but_time(run.method.state(), before)
    pruned = padgs.load_run(run.folder.with_name(result.run), device="cpu")
    kept = search.steps[search.complete(1.0)]
    assert next(iter(pruned.method.size().counts.values())) == kept.rows < search.rows
    assert kept.rows == search.steps[smallest(search.steps, 1.0)].rows
    assert pruned.result == result and result.need.items() >= json.loads(json.dumps(need(search))).items()
    assert result.model_bytes == kept.bytes and pruned.config.variant == "need 1 dB"
    assert keep(Search(opened(method)), 1.0) == result, "what was kept before stays"
    assert pruned.score("sphere").metrics == pytest.approx(pruned.scores["sphere"].metrics, nan_ok=True)
    told = result.need
    assert [step["kind"] for step in told["steps"]][:3] == ["waste", "control", "prune"]
    assert told["needs"]["1"] is not None and told["steps"][0]["loss"] == 0


@pytest.mark.parametrize("method", METHODS)
def test_waste_is_what_no_training_view_shows(opened, method):
    run = opened(method)
    model, views = run.method.resumed(run.scene, 60), run.scene.train
    found = worth(model, views)
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
    found = worth(model, run.scene.train[:2])
    kept = most_wanted(found, 20)
    assert len(kept) == 20 and found.change[kept].min() >= found.change.sort(descending=True).values[20]
    assert torch.equal(kept, kept.sort().values)
    with pytest.raises(ValueError, match="no views"):
        worth(model, ())


def test_steps_of_another_model_are_refused(opened):
    search = Search(opened("method=omnigs"))
    search.complete(1.0)
    search.folder._of = "another"
    with pytest.raises(CheckpointError, match="is of another model than the run has now; delete"):
        search.folder.steps()


def test_ctrl_c_says_what_is_safe(opened, monkeypatch):
    monkeypatch.setattr(session.Interrupt, "requested", True)
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
    (run.folder / "result.json").rename(run.folder / "elsewhere")
    assert "is not finished" in refused(run.folder)
    shutil.rmtree(run.folder / "checkpoint")
    assert "has no checkpoint" in refused(run.folder)


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        pytest.param(
            ("method=egonerf_small",),
            "egonerf has no Gaussians that could be left out",
            marks=pytest.mark.slow,  # its scoring takes seconds
        ),
        (("method=sc_omnigs",), "its cameras learn along"),
        (("method=omnigs", "data.generator.train_views=5"), "5 training views leave no calibration views"),
    ],
)
def test_runs_without_gaussians_views_or_known_cameras_are_refused(opened, settings, why):
    assert why in refused(opened(*settings, "train.iterations=2").folder)
