"""Runs on a real Slurm, which `sh tests/cluster/slurm.sh start` sets up; half an hour on two cores."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        "SLURM_CONF" not in os.environ, reason="no Slurm: sh tests/cluster/slurm.sh start, then SLURM_CONF"
    ),
]
GENERATOR = ["data.generator.width=64", "data.generator.points=500"]
TINY = ["-m", "+experiment=smoke", *GENERATOR, "protocol=sphere", "tracking=none", "run.threads=1"]
RESOURCES = {"cpus_per_task": "1", "gpus_per_node": "null", "mem_gb": "1"}
SLURM = ["launcher=slurm", *(f"hydra.launcher.{key}={value}" for key, value in RESOURCES.items())]
LONG = ["train.iterations=2500", "run.checkpoint_seconds=5"]
SHORT = ["method=omnigs", "train.iterations=5"]


def start(folder, *settings, launcher=SLURM) -> subprocess.Popen:
    command = [Path(sys.executable).with_name("padgs-run"), *TINY, *launcher, f"run.folder={folder}", *settings]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def end(process: subprocess.Popen) -> str:
    return process.communicate(timeout=1800)[0]


def call(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def wait(condition, seconds=300) -> None:
    for _ in range(seconds):
        if condition():
            return
        time.sleep(1)
    raise AssertionError("waited too long")


def checkpoints(folder) -> set[str]:
    """Return the names of checkpoints, which are digests of model, optimizer and random state."""
    return {path.name for path in folder.glob("*/checkpoint/tensors-*")}


def trains(folder) -> bool:
    """Return whether a run has a checkpoint of more than its first iteration."""
    return any(
        int(re.search(r'"iteration": (\d+)', path.read_text())[1]) > 50
        for path in folder.glob("*/checkpoint/state.json")
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> set[str]:
    """Return the checkpoint of a run that nothing interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    assert "1 of 1 done" in end(start(folder, *LONG, launcher=["launcher=submitit"]))
    return checkpoints(folder)


def test_an_array_of_runs(tmp_path):
    assert "24 of 24 done" in end(start(tmp_path, *SHORT, "seed=range(24)"))


def test_a_run_beyond_its_time_limit_is_requeued_and_resumes_bit_identically(tmp_path, whole):
    limits = ["hydra.launcher.timeout_min=2", "hydra.launcher.signal_delay_s=10"]
    assert "1 of 1 done" in end(start(tmp_path, *LONG, *limits))
    assert "REQUEUED" in call("sacct", "-D", "-o", "State") and checkpoints(tmp_path) == whole


def test_a_preempted_run_resumes_bit_identically(tmp_path, whole):
    running = start(tmp_path, *LONG)
    wait(lambda: trains(tmp_path))
    call("sbatch", "-p", "urgent", "-c", "2", "-o", os.devnull, "--wrap", "sleep 10")
    assert "1 of 1 done" in end(running)
    assert "PREEMPTED" in call("sacct", "-D", "-o", "State") and checkpoints(tmp_path) == whole


def test_a_run_resumes_when_its_node_returns(tmp_path, whole):
    running = start(tmp_path, *LONG)
    wait(lambda: trains(tmp_path))
    daemon = Path(os.environ["SLURM_CONF"]).with_name("slurmd.pid")
    os.kill(int(daemon.read_text()), signal.SIGKILL)
    for name in ("slurmstepd: \\[", f"_submit {tmp_path}"):
        for number in subprocess.run(["pgrep", "-f", name], capture_output=True, text=True).stdout.split():
            os.kill(int(number), signal.SIGKILL)
    wait(lambda: "down" in call("sinfo", "-h", "-p", "main"))
    call("slurmd", "-f", os.environ["SLURM_CONF"], "-N", "localhost")
    assert "1 of 1 done" in end(running) and checkpoints(tmp_path) == whole


def test_cancelled_runs_are_finished_by_the_same_command(tmp_path):
    arguments = (tmp_path, *SHORT, "seed=range(6)")
    running = start(*arguments)
    wait(lambda: (tmp_path / ".multirun" / "finished.jsonl").exists())
    array = call("squeue", "-h", "-n", "padgs", "-o", "%F").split()[0]
    call("scancel", *(f"{array}_{index}" for index in (3, 4, 5)))
    assert "3 of 6 done, 3 stopped" in end(running)
    again = end(start(*arguments))
    assert "3 of 6 done (3 before)" in again and "6 of 6 done (3 before)" in again


def test_the_same_command_goes_on_after_the_login_process_was_killed(tmp_path):
    arguments = (tmp_path, *SHORT, "seed=range(4)")
    killed = start(*arguments)
    wait(lambda: "R" in call("squeue", "-h", "-n", "padgs", "-o", "%t").split())
    killed.kill()
    end(killed)
    assert "4 of 4 done" in end(start(*arguments))


def test_runs_beyond_a_limit_of_jobs_are_submitted_later(tmp_path):
    call("sacctmgr", "-i", "modify", "user", "root", "set", "MaxSubmitJobs=3")
    try:
        assert "4 of 4 done" in end(start(tmp_path, *SHORT, "seed=range(4)"))
    finally:
        call("sacctmgr", "-i", "modify", "user", "root", "set", "MaxSubmitJobs=-1")
