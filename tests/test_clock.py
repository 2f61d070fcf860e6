import datetime
import json
import mmap
import subprocess
import sys
import time

import pytest
import torch

from padgs import clock


def test_wall_and_cpu_time_are_told_apart():
    sleeping = clock.measure(lambda: time.sleep(0.01), repeats=3, warm_up=0)
    assert 0.01 <= sleeping["wall"]["min"] < 0.5
    assert sleeping["cpu"]["median"] < 0.005

    def work() -> None:
        until = time.process_time() + 0.01
        while time.process_time() < until:
            pass

    assert clock.measure(work, repeats=3, warm_up=0)["cpu"]["min"] >= 0.01


def test_warm_up_runs_do_not_count():
    calls = []
    timing = clock.measure(lambda: time.sleep(0.05 if len(calls) < 2 else 0) or calls.append(1), repeats=4, warm_up=2)
    assert len(calls) == 6 and timing["repeats"] == 4
    assert timing["wall"]["p95"] < 0.05


def test_summary_of_known_numbers():
    assert clock.summary([float(value) for value in range(100, 0, -1)]) == {"median": 50.5, "p95": 95.0, "min": 1.0}
    assert clock.summary([2.0]) == {"median": 2.0, "p95": 2.0, "min": 2.0}


def test_timed_returns_the_value_and_cpu_time():
    value, seconds = clock.timed(lambda: time.sleep(0.1) or "done")
    assert value == "done" and 0 <= seconds < 0.05


@pytest.mark.skipif(sys.platform != "linux", reason="the peak can be reset on Linux only")
def test_peak_memory_sees_what_was_freed_again_and_can_be_reset():
    size = 200 * 2**20
    clock.reset_peak_memory()
    before = clock.peak_memory()["peak_memory_bytes"]
    with mmap.mmap(-1, size) as block:  # pages of its own: a tensor may lie in memory that earlier tests left the heap
        for page in range(0, size, mmap.PAGESIZE):
            block[page] = 1
    after = clock.peak_memory()["peak_memory_bytes"]
    assert size * 0.9 < after - before < size * 1.5
    clock.reset_peak_memory()
    assert clock.peak_memory()["peak_memory_bytes"] < after - size * 0.5
    assert clock.peak_memory()["peak_device_memory_bytes"] is None


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_peak_memory_of_a_child_is_its_own():
    block = torch.ones(100 * 2**20)  # 400 MB here
    code = "import runpy, sys; from padgs.clock import peak_memory; print(peak_memory()['peak_memory_bytes'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=_root())
    assert clock.peak_memory()["peak_memory_bytes"] > block.numel() * 4
    assert int(done.stdout) < clock.peak_memory()["peak_memory_bytes"] - block.numel() * 2


def test_peak_memory_of_a_gpu_is_that_of_its_tensors(monkeypatch):
    held = {torch.device("cuda", 1): 7}
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: held[device])
    assert clock.peak_memory(torch.device("cuda", 1))["peak_device_memory_bytes"] == 7


def test_the_machine_is_described_in_json():
    description = json.loads(json.dumps(clock.machine()))
    assert description["torch"] == torch.__version__
    assert description["threads"] == torch.get_num_threads()
    assert description["cores"] >= 1 and description["memory"] > 2**28
    assert description["gpu"] is None and description["cpu"]
    age = datetime.datetime.now(datetime.timezone.utc) - datetime.datetime.fromisoformat(description["date"])
    assert abs(age.total_seconds()) < 60


def test_the_commit_is_that_of_the_checkout(tmp_path):
    assert clock.commit.__wrapped__(tmp_path) is None  # an installed package

    def git(*arguments: str) -> str:
        identity = ("-c", "user.name=t", "-c", "user.email=t@t", "-c", "commit.gpgsign=false")
        command = ["git", *identity, "-C", str(tmp_path), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "-q")
    (tmp_path / "file").write_text("a")
    git("add", "file")
    git("commit", "-q", "-m", "First")
    assert clock.commit.__wrapped__(tmp_path) == git("rev-parse", "HEAD")
    (tmp_path / "file").write_text("b")
    assert clock.commit.__wrapped__(tmp_path) == git("rev-parse", "HEAD") + "+"


def test_measurements_have_the_commit_of_the_running_code(monkeypatch):
    """Later the checkout may have another one, or files that differ from it."""
    started = clock.machine()["commit"]
    monkeypatch.setattr(clock.subprocess, "run", None)
    assert clock.machine()["commit"] == started


def _root() -> str:
    return clock.__file__.rsplit("/", 2)[0]
