import json

import pytest

from padgs.multirun import finished
from padgs.multirun.finished import FinishedJobs

JOB = ["method=padgs", "++seed=1"]


@pytest.fixture
def runs(tmp_path):
    """A folder of runs with one finished run of one job."""
    folder = tmp_path / "runs"
    (folder / "room_padgs_1").mkdir(parents=True)
    (folder / "room_padgs_1" / "result.json").write_text("{}")
    FinishedJobs(folder).add(JOB, "room_padgs_1", "ok", None)
    return folder


def test_a_finished_job_is_known_at_the_next_start(runs):
    assert FinishedJobs(runs).find(JOB) == ("ok", "room_padgs_1")
    assert FinishedJobs(runs).find(["method=padgs", "++seed=2"]) is None


def test_settings_without_effect_on_results_are_ignored(runs):
    for extra in ("++run.threads=2", "launcher=local", "tracking=none", "++retry=failed", "hydra.verbose=true"):
        assert FinishedJobs(runs).find([extra, *reversed(JOB)]) == ("ok", "room_padgs_1")


@pytest.mark.parametrize(
    "setting",
    ["init=runs/other", "++data.images=/a", "data.mask=/a.png", "data.points=/a.ply", "data.path=${oc.env:A}"],
)
def test_a_job_that_reads_other_files_than_those_of_its_data_is_looked_up(runs, setting):
    job = [setting, *JOB]
    FinishedJobs(runs).add(job, "room_padgs_1", "ok", None)
    assert FinishedJobs(runs).find(job) is None, "they may have changed, or another run been trained anew"


def test_a_result_that_is_gone_or_was_written_anew_is_looked_up(runs):
    path = runs / "room_padgs_1" / "result.json"
    content = path.read_text()
    path.unlink()
    assert FinishedJobs(runs).find(JOB) is None
    path.write_text(content)
    assert FinishedJobs(runs).find(JOB) is None


def test_a_job_whose_result_was_gone_when_it_was_noted_is_looked_up(runs):
    FinishedJobs(runs).add(JOB, "nowhere", "ok", None)
    assert FinishedJobs(runs).find(JOB) is None


@pytest.mark.parametrize("name", ["", "transforms.json"])
def test_data_that_changed_are_looked_up(runs, tmp_path, name):
    data, images = tmp_path / "data", tmp_path / "images"
    for folder in (data, images):
        folder.mkdir()
    (data / "transforms.json").write_text("{}")
    (data / "images").symlink_to(images)
    (data / "itself").symlink_to(data)
    (images / "0.png").write_bytes(b"1")
    finished.signature.cache_clear()
    FinishedJobs(runs).add(JOB, "room_padgs_1", "ok", str(data / name))
    finished.signature.cache_clear()
    assert FinishedJobs(runs).find(JOB) == ("ok", "room_padgs_1")
    (images / "0.png").write_bytes(b"22")
    finished.signature.cache_clear()
    assert FinishedJobs(runs).find(JOB) is None


def test_other_sources_are_looked_up(runs, monkeypatch):
    monkeypatch.setattr(finished, "_sources", lambda: ("other",))
    assert FinishedJobs(runs).find(JOB) is None


def test_another_version_of_a_package_with_a_method_is_looked_up(runs, monkeypatch):
    versions = {"plugged": "plug 1.0"}
    monkeypatch.setattr(finished.baselines, "outside", lambda: {"plugged": "plugged_in:Method"})
    monkeypatch.setattr(finished.baselines, "distribution", versions.get)
    finished._sources.cache_clear()
    FinishedJobs(runs).add(JOB, "room_padgs_1", "ok", None)
    assert FinishedJobs(runs).find(JOB) == ("ok", "room_padgs_1")
    versions["plugged"] = "plug 1.1"
    finished._sources.cache_clear()
    assert FinishedJobs(runs).find(JOB) is None
    finished._sources.cache_clear()


def test_a_cut_line_costs_only_its_own_job(runs):
    path = runs / ".multirun" / "finished.jsonl"
    path.write_text('{"job": "cut\n' + path.read_text() + json.dumps(["no", "entry"]))
    assert FinishedJobs(runs).find(JOB) == ("ok", "room_padgs_1")
