import json
import os
import shutil
import signal
from dataclasses import replace

import pytest
import torch
from support.composed import composed
from support.training import ITERATIONS, SMALL, folder_of, run, stop_at

from padgs import clock
from padgs.data.capture import DataError
from padgs.methods.anchors.method import PaDGSMethod
from padgs.runs import checkpoint
from padgs.runs.checkpoint import CheckpointError
from padgs.runs.interrupt import Interrupted
from padgs.training.health import Failure

MACHINE = clock.machine()


def test_ctrl_c_finishes_the_step_and_the_next_start_ends_bit_identically(config, monkeypatch, tmp_path):
    undisturbed, _ = run(replace(config, run=replace(config.run, folder=str(tmp_path / "undisturbed"))))
    with monkeypatch.context() as patch:
        stop_at(7, patch, lambda: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(Interrupted, match="stopped after iteration 8"):
            run(config)
    assert checkpoint.load(folder_of(config).checkpoint).values["progress"]["iteration"] == 8
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    resumed, said = run(config)
    assert "resuming after iteration 8" in said
    assert resumed.scores == undisturbed.scores
    same_checkpoint(config, replace(config, run=replace(config.run, folder=str(tmp_path / "undisturbed"))))


def test_peak_memory_is_that_of_all_processes_that_trained(config, monkeypatch):
    peaks = {"peak_memory_bytes": 9, "peak_device_memory_bytes": None}
    monkeypatch.setattr(clock, "peak_memory", lambda device: dict(peaks))
    with monkeypatch.context() as patch:
        stop_at(7, patch, lambda: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(Interrupted):
            run(config)
    peaks |= {"peak_memory_bytes": 5, "peak_device_memory_bytes": 3}
    with monkeypatch.context() as patch:
        stop_at(10, patch, lambda: failing())
        failed, _ = run(config)
    assert (failed.status, failed.peak_memory_bytes) == ("oom", 9)
    config = replace(config, retry="failed")
    result, _ = run(config)
    assert (result.peak_memory_bytes, result.peak_device_memory_bytes) == (9, 3)


def failing() -> None:
    raise MemoryError("for the test")


def test_a_run_of_two_machines_and_two_versions_names_both(config, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(clock, "machine", lambda device: MACHINE | {"cpu": "Old", "commit": "a" * 40})
        stop_at(7, patch, lambda: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(Interrupted):
            run(config)
    monkeypatch.setattr(clock, "machine", lambda device: MACHINE | {"cpu": "New", "commit": "b" * 40})
    result, _ = run(config)
    assert result.machine["cpu"] == "Old then New"
    assert result.code_version == f"{MACHINE['padgs']} {10 * 'a'} then {MACHINE['padgs']} {10 * 'b'}"


def test_ctrl_c_in_the_last_iteration_scores_at_the_next_start(config, monkeypatch):
    with monkeypatch.context() as patch:
        stop_at(ITERATIONS - 1, patch, lambda: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(Interrupted, match=f"stopped after iteration {ITERATIONS}, the checkpoint is written"):
            run(config)
    assert folder_of(config).result() is None
    result, _ = run(config)
    assert result.status == "ok" and result.iterations_done == ITERATIONS


def same_checkpoint(one, other) -> None:
    mine, theirs = (checkpoint.load(folder_of(config).checkpoint) for config in (one, other))
    assert mine.tensors.keys() == theirs.tensors.keys()
    assert all(torch.equal(mine.tensors[name], theirs.tensors[name]) for name in mine.tensors)


def test_a_crash_between_checkpoints_loses_only_what_came_after(config, monkeypatch, tmp_path):
    config = replace(config, run=replace(config.run, checkpoint_every=5, log_every=1))

    def crash():
        raise ZeroDivisionError

    with monkeypatch.context() as patch:
        stop_at(9, patch, crash)
        with pytest.raises(ZeroDivisionError):
            run(config)
    _, said = run(config)
    assert "resuming after iteration 5" in said
    lines = (folder_of(config).path / "log.jsonl").read_text().splitlines()
    assert [json.loads(line)["iteration"] for line in lines] == list(range(1, ITERATIONS + 1))


def test_a_damaged_checkpoint_is_named_and_nothing_is_started(config, monkeypatch):
    with monkeypatch.context() as patch:
        stop_at(7, patch, lambda: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(Interrupted):
            run(config)
    (tensors,) = folder_of(config).checkpoint.glob("*.safetensors")
    tensors.write_bytes(tensors.read_bytes()[:-1])
    monkeypatch.setattr(PaDGSMethod, "fit", lambda *_: pytest.fail("trained"))
    with pytest.raises(CheckpointError, match=tensors.name):
        run(config)
    assert not (folder_of(config).path / "result.json").exists()


@pytest.mark.parametrize("change", ["seed=1", "method.features=16", "train.lambda_l1=0.5"])
def test_a_checkpoint_of_another_run_is_refused(config, monkeypatch, tmp_path, change):
    other = composed(*SMALL, f"run.folder={tmp_path}/other", f"train.iterations={ITERATIONS}", change)
    for one in (config, other):
        with monkeypatch.context() as patch:
            stop_at(7, patch, lambda: os.kill(os.getpid(), signal.SIGINT))
            with pytest.raises(Interrupted):
                run(one)
    shutil.rmtree(folder_of(config).checkpoint)
    shutil.copytree(folder_of(other).checkpoint, folder_of(config).checkpoint)
    monkeypatch.setattr(PaDGSMethod, "fit", lambda *_: pytest.fail("trained"))
    with pytest.raises(CheckpointError, match="is of a run with another configuration; .*delete the folder of the run"):
        run(config)


def test_panoramas_that_cannot_be_read_any_more_interrupt_a_run_and_end_it_not(config, monkeypatch):
    config = replace(config, run=replace(config.run, checkpoint_every=5))

    def fail():
        raise DataError("the disk has gone")

    with monkeypatch.context() as patch:
        stop_at(7, patch, fail)
        with pytest.raises(DataError, match="the disk has gone"):
            run(config)
    result, said = run(config)
    assert result.status == "ok" and "resuming after iteration 5" in said


@pytest.mark.parametrize(("status", "starts_at"), [("nan", 0), ("oom", 5)])
def test_a_failed_run_is_retried_only_if_asked(config, monkeypatch, status, starts_at):
    config = replace(config, run=replace(config.run, checkpoint_every=5))

    def fail():
        raise Failure(status, "for the test")

    with monkeypatch.context() as patch:
        stop_at(7, patch, fail)
        failed, _ = run(config)
    assert failed.status == status and failed.iterations_done == 7 and run(config)[0] == failed
    (folder_of(config).path / "stop").touch()  # too late
    retried, said = run(replace(config, retry="failed"))
    assert retried.status == "ok" and not retried.ended
    assert ("resuming after iteration 5" in said) == (starts_at == 5)  # what went wrong must not be gone on from
    assert run(replace(config, retry="failed"))[0] == retried
