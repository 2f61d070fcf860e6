"""Jobs that submitit launches."""

import os

import pytest
from omegaconf import OmegaConf

from padgs.multirun import sweep
from padgs.multirun.job import SHOWN_GPUS, Board, JobState, job_of_many


@pytest.mark.parametrize("shown", ["1", "3,0", "", "GPU-8f2a"])
def test_jobs_of_submitit_see_the_gpus_that_the_command_sees(shown, tmp_path, monkeypatch):
    submitit = pytest.importorskip("submitit")
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")

    class Executor:
        def update_parameters(self, **_):
            pass

        def map_array(self, *_):
            return []

    launcher = type("Launcher", (), {"__module__": "submitit", "_EXECUTOR": "local"})()
    launcher.params = {"submitit_folder": str(tmp_path), "gpus_per_node": 1}
    monkeypatch.setattr(submitit, "AutoExecutor", lambda **_: Executor())
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", shown)
    monkeypatch.setenv(SHOWN_GPUS, "")  # to be removed after the test
    sweep.launch(launcher, [["seed=0"]], 0, Board(tmp_path / "board"))
    monkeypatch.setattr("padgs.multirun.job.answer_signals", lambda: None)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")  # as submitit sets it for each job
    with pytest.raises(ValueError, match="HydraConfig was not set"):
        job_of_many(OmegaConf.create())
    assert os.environ["CUDA_VISIBLE_DEVICES"] == shown


def test_a_finished_slurm_job_whose_log_is_not_visible_yet_stays_finished(tmp_path, monkeypatch):
    submitit = pytest.importorskip("submitit")
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")

    class Executor:
        def __init__(self, **_):
            pass

        def update_parameters(self, **_):
            pass

        def map_array(self, *_):
            return ["job", "job"]

    launcher = type("Launcher", (), {"__module__": "submitit", "_EXECUTOR": "slurm"})()
    launcher.params = {"submitit_folder": str(tmp_path)}
    monkeypatch.setattr(submitit, "AutoExecutor", Executor)
    monkeypatch.setattr(sweep, "wait_for_jobs", lambda *_: [0, 1])
    board = Board(tmp_path / "board")
    board.write(7, JobState("ok", "room"))
    sweep.launch(launcher, [["seed=0"], ["seed=1"]], 7, board)
    assert [board.read(number).status for number in (7, 8)] == ["ok", "stopped"]
    assert board.read(8).reason == sweep.LEFT_QUEUE, "nobody asked for a stop"
