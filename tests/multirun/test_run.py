"""`padgs-run` as a process: exit codes, messages, and runs that are killed."""

import os
import random
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from hydra.errors import HydraException
from support.tiny_run import SMALLEST, finish

from padgs.multirun.job import exit_on_errors
from padgs.multirun.overrides import lenient
from padgs.reports import store
from padgs.runs import checkpoint
from padgs.training.health import Failure

ROOT = Path(__file__).resolve().parents[2]
TINY = [*SMALLEST, "train.iterations=300", "run.checkpoint_every=10", "run.probe_every=50", "tracking=none"]
ANNOUNCED = """
from padgs.multirun import run
begin = run._answer
def announce(arguments):  # inside of what answers Ctrl-C: a signal sent on this word is never too early
    print("begun", flush=True)
    begin(arguments)
run._answer = announce
run.main()
"""


@pytest.mark.parametrize("delay", [0.0, pytest.param(0.2, marks=pytest.mark.slow), 1.0])
def test_ctrl_c_is_answered_while_the_program_starts(delay):
    settings = ["train.iterations=20000" if one.startswith("train.iterations") else one for one in TINY]
    command = [sys.executable, "-c", ANNOUNCED, *settings]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    code, _, error = finish(process)
    assert code == 130 and "Traceback" not in error and "to go on: padgs-run" in error


def newest(folder: Path) -> bytes:
    """Return the state file of the checkpoint of the only run in a folder."""
    return next((path.read_bytes() for path in folder.glob("*/checkpoint/state.json")), b"")


def wait_for_new_checkpoint(folder: Path, before: bytes, process: subprocess.Popen) -> None:
    deadline = time.monotonic() + 120
    while process.poll() is None and newest(folder) == before:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def same_end(one: Path, other: Path) -> None:
    """Assert that metrics, checkpoint and log of the only run in each folder are equal, bit by bit."""
    mine, theirs = (store.read(folder)[0][0].result for folder in (one, other))
    assert mine.status == "ok"
    assert (mine.run, mine.scores, mine.counts) == (theirs.run, theirs.scores, theirs.counts)
    first, second = (checkpoint.load(folder / mine.run / "checkpoint") for folder in (one, other))
    assert first.tensors.keys() == second.tensors.keys()
    assert all(torch.equal(first.tensors[name], second.tensors[name]) for name in first.tensors)
    lines = [(folder / mine.run / "log.jsonl").read_text() for folder in (one, other)]
    without_times = [re.sub(r'"seconds": [0-9.]+', "", text) for text in lines]
    assert without_times[0] == without_times[1]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["padgs", "omnigs"])
def test_killed_and_interrupted_runs_end_bit_identically(start, tmp_path, method):
    arguments = [*TINY, f"method={method}"]
    code, _, error = finish(start(*arguments, "run.folder=undisturbed"))
    assert code == 0, error
    source = random.Random(time.time_ns())  # a random moment: any must do
    for number in (signal.SIGKILL, signal.SIGINT, signal.SIGTERM):
        before = newest(tmp_path / "disturbed")
        process = start(*arguments, "run.folder=disturbed")
        wait_for_new_checkpoint(tmp_path / "disturbed", before, process)
        time.sleep(source.uniform(0, 0.1))
        process.send_signal(number)
        code, _, error = finish(process)
        if number != signal.SIGKILL and code != 0:  # 0: the run was faster than the signal
            assert code == 128 + number and "to go on: padgs-run" in error, error
    code, out, error = finish(start(*arguments, "run.folder=disturbed"))
    assert code == 0, error
    same_end(tmp_path / "disturbed", tmp_path / "undisturbed")


@pytest.mark.slow
def test_the_ablation_is_one_command_and_its_table_another(start, tmp_path, cache):
    quick = [argument for argument in TINY if not argument.startswith("train.iterations")]
    code, out, error = finish(start("+experiment=ablation", *quick, "train.iterations=30"))
    assert code == 0, error
    found, broken = store.read(tmp_path / "runs")
    variants = {run.result.variant for run in found}
    assert variants == {"baseline", "dagd", "dagd_daom_no_m", "full"} and not broken
    report = [sys.executable, "-m", "padgs.cli.app", "report", "table3"]
    done = subprocess.run(
        report, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for result in (run.result for run in found):
        assert f"{result.scores['paper'].metrics['psnr']:.2f}" in done.stdout
    written = {path.name for path in (tmp_path / "runs" / "reports").iterdir()}
    assert written == {"table3.csv", "table3.md", "table3.tex"}
    assert {path.name for path in tmp_path.iterdir()} == {"runs"}, "Hydra left something behind"


@pytest.mark.slow  # five processes
def test_a_missing_data_set_says_where_to_get_it_and_where_to_put_it(start, tmp_path):
    code, _, error = finish(start("+experiment=ablation_bar"))
    assert code == 1
    assert "huajianup.github.io" in error and f"put it into {tmp_path}/data/360roam," in error
    assert error.count("error:") == 1 and "Traceback" not in error


@pytest.mark.slow  # a process each; `tests/runs/test_run.py` has the same in one
@pytest.mark.parametrize("arguments", [[], ["+sweep=seeds"]])
def test_a_folder_that_cannot_be_written_is_a_clear_error(start, tmp_path, arguments):
    (tmp_path / "runs").write_text("a file where the folder should be")
    code, _, error = finish(start(*TINY, *arguments))
    assert code == 1 and "cannot write run folder runs/" in error and "Traceback" not in error


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("train.iteration=5", "; did you mean train.iterations?"),
        *(
            pytest.param(argument, message, marks=pytest.mark.slow)  # a process each
            for argument, message in (
                ("sede=5", "unknown key sede; known: data, render"),
                ("method=omnigss", "did you mean omnigs?"),
                ("seed=0,1", "seed=0,1 has several values; give -m for one run each"),
                ("variant=a;b", "variant=a;b cannot be read: values with spaces or other signs"),
                ("iterations=5", "did you mean train.iterations?"),
                ("method=foo", "unknown method 'foo'; known: crops_3dgs"),
                ("+experiment=foo", "unknown experiment 'foo'; known: ablation"),
                ("data.path=/no/such/folder", "/no/such/folder"),
                ("protocol=null", "protocol is a group of settings, chosen by name"),
                ("render.near=${nothing}", "Interpolation key 'nothing' not found"),
            )
        ),
    ],
)
def test_unknown_names_are_reported_with_the_known_ones(start, argument, message):
    code, _, error = finish(start(argument))
    assert code == 1 and message in error and "Traceback" not in error


def test_only_values_are_forced_past_hydra():
    line = shlex.split("method=omnigs +experiment=x ++a.b=1 ~c hydra.mode=RUN -m seed=1 train.max_seconds=3")
    forced = shlex.split("method=omnigs +experiment=x ++a.b=1 ~c hydra.mode=RUN -m ++seed=1 ++train.max_seconds=3")
    assert lenient(line) == forced


@pytest.mark.parametrize(
    "error", [Failure("oom", "no memory for a search"), ValueError("no such data"), HydraException("no such choice")]
)
def test_expected_errors_are_reported_without_a_traceback(capsys, error):
    with pytest.raises(SystemExit, match="1"), exit_on_errors():
        raise error
    assert capsys.readouterr().err == f"error: {error}\n"


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes")]
)
def test_a_lack_of_memory_is_reported_with_a_way_out(capsys, error):
    with pytest.raises(SystemExit, match="1"), exit_on_errors():
        raise error
    said = capsys.readouterr().err
    assert said.startswith("error: out of memory: ") and "data.width" in " ".join(said.split())


def test_other_errors_keep_their_traceback():
    with pytest.raises(RuntimeError, match="a fault"), exit_on_errors():
        raise RuntimeError("a fault")
