import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from filelock import FileLock
from typer.testing import CliRunner

from padgs import results
from padgs.checks import install_command
from padgs.cli.commands import app
from padgs.results import Result, Scores
from padgs.runs import tracking
from padgs.runs.tracking import Tracker, TrackingOptions

NEEDS_MLFLOW = pytest.mark.filterwarnings("ignore")  # what it warns of is not ours


def make_run(runs: Path, name: str = "room_padgs_1", *, status: str = "ok") -> Path:
    run = runs / name
    (run / "renders").mkdir(parents=True)
    (run / "renders" / "000.png").write_bytes(b"a picture")
    lines = ({"iteration": n, "loss": 1 / n, "events": ["x"]} for n in range(10, 31, 10))
    (run / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    machine = {"cpu": "a processor", "cores": 2, "torch": "2.13.0", "gpu": None}
    marks = {"paper": Scores({"lpips": "none"}, {"psnr": 20.0, "ssim": None}, {})} if status == "ok" else {}
    result = Result(
        run=name, status=status, method="padgs", preset="padgs", variant="", dataset="synthetic", scene="room",
        width=64, height=32, iterations=30, iterations_done=30, seed=0, code_version="0", machine=machine,
        config_hash="", fingerprint="", finished="", config={"method": {"name": "padgs", "tau": 0.9}, "seed": 0},
        scores=marks, counts={"anchors": 5}, experiments=("tau",),
    )  # fmt: skip
    results.write(result, run)
    return run


@pytest.fixture
def said():
    return []


def test_none_needs_nothing_and_writes_nothing(tmp_path, said, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: pytest.fail("looked for mlflow"))
    tracker = Tracker(TrackingOptions("none"), tmp_path, "tau", said.append)
    tracker.add(make_run(tmp_path))
    assert said == [] and [path.name for path in tmp_path.iterdir()] == ["room_padgs_1"]


@pytest.mark.parametrize(
    ("options", "lines"), [(TrackingOptions(), 0), (TrackingOptions("mlflow"), 1), (TrackingOptions(uri="http://a"), 1)]
)
def test_without_mlflow_one_line_says_so_to_who_asked_for_it(tmp_path, said, monkeypatch, options, lines):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    tracker = Tracker(options, tmp_path, "tau", said.append)
    tracker.add(make_run(tmp_path))
    tracker.finish([], 0)
    assert not tracker.on and len(said) == lines
    assert all(install_command("mlflow") in line and "tracking=none" in line for line in said)


@NEEDS_MLFLOW
def test_runs_stand_in_mlflow_with_settings_progress_marks_and_pictures(tmp_path, said, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    runs = tmp_path / "runs"
    good, bad = make_run(runs), make_run(runs, "room_padgs_2", status="nan")
    monkeypatch.chdir(tmp_path)  # what mlflow writes where it stands would be found here
    copy = shutil.copytree(good, runs / "the best")
    for _ in range(2):  # the second time as after a restart: everything is found again
        tracker = Tracker(TrackingOptions(), Path("runs"), "tau", said.append, multirun="tau 1234")
        tracker.add(good)
        tracker.add(copy)
        tracker.add(bad)
        tracker.finish(["ok", "nan"], 2)
    client = mlflow.MlflowClient(f"sqlite:///{runs / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("tau")
    every = client.search_runs([experiment.experiment_id])
    stored = {run.info.run_name: run for run in every}
    assert said == [] and sorted(run.info.run_name for run in every) == ["room_padgs_1", "room_padgs_2", "tau 1234"]
    run, parent = stored["room_padgs_1"], stored["tau 1234"]
    assert run.data.params == {"method.name": "padgs", "method.tau": "0.9", "seed": "0"}
    assert run.data.metrics["paper/psnr"] == 20 and "paper/ssim" not in run.data.metrics
    assert run.data.tags["mlflow.parentRunId"] == parent.info.run_id
    assert (run.info.status, stored["room_padgs_2"].info.status, parent.info.status) == ("FINISHED", "FAILED", "FAILED")
    history = client.get_metric_history(run.info.run_id, "train/loss")
    assert sorted(point.step for point in history) == [10, 20, 30]
    artifacts = {item.path for folder in ("", "renders") for item in client.list_artifacts(run.info.run_id, folder)}
    assert {"result.json", "renders/000.png"} <= artifacts
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    results.write(replace(results.read(bad / "result.json"), status="ok", finished="later"), bad)
    tracker.add(bad)  # it was started again: the failed attempt stays
    again = client.search_runs([experiment.experiment_id], "tags.`padgs.run` = 'room_padgs_2'")
    assert sorted(run.info.status for run in again) == ["FAILED", "FINISHED"]
    scored = replace(results.read(good / "result.json"), experiments=("tau", "table1"))
    results.write(scored, good)
    tracker.add(good)  # with something new, although it ended at the same time
    assert len(client.search_runs([experiment.experiment_id], "tags.`padgs.run` = 'room_padgs_1'")) == 2
    (runs / "mlflow.db").write_text("no database any more")
    results.write(replace(results.read(good / "result.json"), finished="later"), good)
    tracker.add(good)
    tracker.add(good)
    assert len(said) == 1 and "padgs track" in said[0]


@NEEDS_MLFLOW
def test_a_server_that_is_away_and_a_lock_that_is_never_free_cost_a_line(tmp_path, said, monkeypatch):
    pytest.importorskip("mlflow")
    run = make_run(tmp_path)
    tracker = Tracker(TrackingOptions(uri="http://127.0.0.1:9"), tmp_path, "tau", said.append)
    for _ in range(3):
        tracker.add(run)
    assert len(said) == 1 and "no longer mirrored into mlflow at http://127.0.0.1:9" in said[0]
    monkeypatch.setattr(tracking, "PATIENCE", 0.1)
    with FileLock(tmp_path / ".mlflow.lock"):
        Tracker(TrackingOptions(), tmp_path, "tau", said.append).add(run)
    assert len(said) == 2 and "Timeout" in said[1] and results.read(run / "result.json").ok


def test_a_folder_of_a_run_is_mirrored_whatever_its_name(tmp_path, monkeypatch):
    make_run(tmp_path).rename(tmp_path / "the best")
    mirrored = []
    fake = SimpleNamespace(name="tau", on=True, add=mirrored.append)
    monkeypatch.setattr(tracking, "Tracker", lambda *_: fake)
    done = CliRunner().invoke(app, ["track", str(tmp_path)])
    assert done.exit_code == 0 and mirrored == [tmp_path / "the best"]
    done = CliRunner().invoke(app, ["track", str(tmp_path / "rums")])
    assert done.exit_code == 1 and f"there is no folder {tmp_path / 'rums'}" in done.output


@pytest.mark.slow
@NEEDS_MLFLOW
def test_runs_of_a_cluster_are_mirrored_later(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    make_run(tmp_path)
    make_run(tmp_path, "room_padgs_2")
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "result.json").write_text("{")
    done = CliRunner().invoke(app, ["track", str(tmp_path), "--uri", f"sqlite:///{tmp_path}/other.db"])
    assert done.exit_code == 0 and "mirrored: 2 runs, as tau" in done.output and "left out: " in done.output
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path}/other.db")
    assert len(client.search_runs([client.get_experiment_by_name("tau").experiment_id])) == 2
    assert list(Path.cwd().iterdir()) == []
    away = CliRunner().invoke(app, ["track", str(tmp_path), "--uri", "http://127.0.0.1:9"])
    assert away.exit_code == 1 and "no longer mirrored" in away.output
