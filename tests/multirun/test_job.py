import pytest
from omegaconf import OmegaConf

from padgs.multirun import job
from padgs.multirun.board import REFUSED
from padgs.multirun.job import TrackedRun
from padgs.training.health import Failure


def test_a_run_in_progress_is_mirrored_at_intervals(tmp_path, monkeypatch):
    looks = []
    watch = TrackedRun(type("Fake", (), {"update": lambda self, run: looks.append(run)})())
    watch.saved(tmp_path)
    assert looks == []
    monkeypatch.setattr(job, "SECONDS_BETWEEN_LOOKS", 0.0)
    watch.saved(tmp_path)
    assert looks == [tmp_path]


@pytest.mark.parametrize("error", [Failure("oom", "no memory for a search"), ValueError("no such data")])
def test_expected_errors_are_reported_without_a_traceback(monkeypatch, capsys, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(job, "typed_config", fail)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    assert job.only_job(OmegaConf.create(), {}) == REFUSED
    assert capsys.readouterr().err == f"error: {error}\n"
