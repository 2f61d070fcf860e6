"""Whole sweeps of tiny runs as processes: killed at random moments, and by different launchers."""

import os
import random
import re
import signal
import socket
import subprocess
import time
from pathlib import Path
from unittest.mock import Mock

import pytest
from omegaconf import OmegaConf
from support.tiny_run import SMALLEST, finish

from padgs.checks import ConfigError
from padgs.multirun.composition import composing, multirun
from padgs.multirun.overrides import root
from padgs.multirun.sweep import sweep
from padgs.reports import store

TINY = [*SMALLEST, "train.iterations=40", "run.checkpoint_every=5", "tracking=none"]
SWEEP = ["-m", "method=padgs", "method.tau=0.0,0.5,0.9,1.0", "seed=0,1,2"]


def marks(folder: Path) -> dict[str, tuple]:
    """Run -> all that must not depend on how it came about."""
    found, broken = store.read(folder)
    assert not broken
    ends = [run.result for run in found]
    return {result.run: (result.status, result.scores, result.counts, result.iterations_done) for result in ends}


def test_an_unknown_key_of_tracking_is_refused(tmp_path):
    hydra = {"sweep": {"dir": str(tmp_path / "start")}, "launcher": {"_target_": "x.BasicLauncher"}}
    hydra |= {"runtime": {"choices": {}}, "sweeper": {"params": None}, "overrides": {"task": ["++seed=0"]}}
    config = {"run": {"folder": str(tmp_path)}, "retry": "none", "tracking": {"knid": "none"}, "hydra": hydra}
    with pytest.raises(ConfigError, match="unknown key tracking.knid; known: tracking.kind.*did you mean"):
        sweep(OmegaConf.create(config), Mock())


@pytest.mark.parametrize(
    ("device", "here", "asked"), [("cuda", False, 1), ("auto", True, 1), ("auto", False, 0), ("cpu", True, 0)]
)
def test_runs_of_ray_ask_for_the_gpu_that_they_use(monkeypatch, device, here, asked):
    monkeypatch.setattr("torch.cuda.is_available", lambda: here)
    ray = OmegaConf.load(root() / "conf" / "launcher" / "ray.yaml")
    config = OmegaConf.merge(ray, {"run": {"device": device, "threads": 3}})
    assert config.hydra.launcher.ray.remote == {"num_cpus": 3, "num_gpus": asked}


@pytest.mark.parametrize(("device", "asked"), [("cuda", 1), ("auto", 1), ("cpu", None)])
def test_jobs_of_slurm_ask_for_a_gpu_unless_they_use_none(device, asked):
    slurm = OmegaConf.load(root() / "conf" / "launcher" / "slurm.yaml")
    assert OmegaConf.merge(slurm, {"run": {"device": device}}).hydra.launcher.gpus_per_node == asked


@pytest.mark.parametrize(("allotted", "told"), [({"SLURM_CPUS_PER_TASK": "8"}, "8"), ({}, "unset")])
def test_steps_of_a_slurm_job_have_all_cores_of_the_job(allotted, told):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    with composing():
        setup = multirun(["-m", "launcher=slurm", "seed=0,1"]).hydra.launcher.setup
    script = "\n".join(["set -e", *setup, "sh -c 'echo ${SRUN_CPUS_PER_TASK-unset}'"])
    done = subprocess.run(["bash", "-c", script], env={"PATH": os.environ["PATH"]} | allotted, capture_output=True)
    assert (done.returncode, done.stdout.decode().split()) == (0, [told]), done.stderr


def test_multiruns_that_two_machines_start_in_one_folder_have_boards_of_their_own():
    with composing():
        folder = multirun(["-m", "seed=0,1", "run.folder=/shared/runs"]).hydra.sweep.dir
    host = re.escape(socket.gethostname())
    assert re.fullmatch(rf"/shared/runs/\.multirun/\d{{8}}-\d{{6}}-{host}-{os.getpid()}", folder)


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["none", "local"])
def test_a_sweep_that_was_killed_three_times_ends_as_if_nothing_had_been(start, tmp_path, launcher):
    if launcher != "none":
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    code, _, error = finish(start(*TINY, *SWEEP, "run.folder=undisturbed"))
    assert code == 0, error
    expected = marks(tmp_path / "undisturbed")
    assert len(expected) == 12
    source = random.Random(time.time_ns())  # a random moment, as asked: any must do
    for number in (signal.SIGKILL, signal.SIGINT, signal.SIGTERM):
        process = start(*TINY, *SWEEP, "run.folder=disturbed", f"launcher={launcher}")
        known = len(list((tmp_path / "disturbed").glob("*/log.jsonl")))
        deadline = time.monotonic() + 120
        while process.poll() is None and len(list((tmp_path / "disturbed").glob("*/log.jsonl"))) <= known:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        time.sleep(source.uniform(0, 1.5))
        if number == signal.SIGTERM:
            process.terminate()  # the parent alone, as a scheduler does
        else:
            os.killpg(process.pid, number)  # all of them, as a terminal does
        code, _, error = finish(process)
        if number != signal.SIGKILL and code != 0:  # 0: the sweep was faster than the signal
            assert code == 128 + number and "to go on: padgs-run" in error, error
    code, out, error = finish(start(*TINY, *SWEEP, "run.folder=disturbed", f"launcher={launcher}"))
    assert code == 0, out + error
    assert marks(tmp_path / "disturbed") == expected
    code, out, _ = finish(start(*TINY, *SWEEP, "run.folder=disturbed"))
    assert code == 0 and out.startswith("12 of 12 done (12 before)\n")


@pytest.mark.slow
def test_all_launchers_give_the_same_results(start, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    found = []
    for launcher in ("none", "local", "submitit"):
        code, out, error = finish(start(*TINY, "-m", "seed=0,1,2,3", f"launcher={launcher}", f"run.folder={launcher}"))
        assert code == 0 and "\n4 of 4 done\n" in out, out + error
        found.append(marks(tmp_path / launcher))
    assert len(found[0]) == 4 and found[0] == found[1] == found[2]


@pytest.mark.slow
def test_two_processes_share_a_sweep_and_do_every_run_once(start, tmp_path):
    processes = [start(*TINY, "-m", "seed=0,1,2,3,4,5") for _ in range(2)]
    ends = [finish(process) for process in processes]
    assert {code for code, _, _ in ends} <= {0, 1}  # 1: the other one was still at the last run
    assert len(marks(tmp_path / "runs")) == 6
    resumed = sum(out.count("resuming") for _, out, _ in ends)
    trained = sum(out.count("100%") for _, out, _ in ends)
    assert (resumed, trained) == (0, 6)
