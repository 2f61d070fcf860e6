"""Signals in every phase of real processes that get them at a known place."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.tiny_run import SMALLEST, finish

from padgs import results

TINY = [*SMALLEST, "train.iterations=20", "run.probe_every=50", "tracking=none", "method=omnigs"]
# Sends itself signals: PHASE=NUMBER,NUMBER ... are the first arguments, up to --. Phases are modules and functions.
HOOKED = """
import importlib, os, sys
split = sys.argv.index("--")
sent = {phase: [int(n) for n in numbers.split(",")] for phase, numbers in (a.split("=") for a in sys.argv[1:split])}
sys.argv[1:] = sys.argv[split + 1:]

def send(phase):
    for number in sent.pop(phase, ()):
        os.kill(os.getpid(), number)

def hook(module, name, phase):
    function = getattr(module, name)
    setattr(module, name, lambda *args, **kwargs: (send(phase), function(*args, **kwargs))[1])

class Importing:
    def find_spec(self, name, path, target=None):
        if name == "torch.nn.functional":
            send("import")
        if name == "padgs.runs.run" and len(sent) > ("import" in sent):
            sys.meta_path.remove(self)
            for module, owner, function, phase in (
                ("padgs.data", "", "load", "load"),
                ("padgs.runs.store", "RunStore", "log", "train"),
                ("padgs.evaluation.scoring", "", "score", "score"),
            ):
                module = importlib.import_module(module)
                hook(getattr(module, owner) if owner else module, function, phase)

sys.meta_path.insert(0, Importing())
from padgs.multirun.run import main
main()
"""
STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGXCPU)
CASES = [("import", signal.SIGHUP), ("load", signal.SIGXCPU), ("train", signal.SIGHUP), ("score", signal.SIGTERM)]


@pytest.fixture
def begin(tmp_path, cache, root):
    """Start `padgs-run` with signals in some phases."""

    def started(arguments: list[str], *before: str, **phases: tuple[int, ...]) -> subprocess.Popen:
        environment = os.environ | {"PYTHONPATH": str(root), "PADGS_CACHE": str(cache), "COLUMNS": "200"}
        hooks = [f"{phase}={','.join(str(int(number)) for number in numbers)}" for phase, numbers in phases.items()]
        command = [*before, sys.executable, "-W", "ignore", "-c", HOOKED, *hooks, "--", *arguments]
        pipe = subprocess.PIPE
        return subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=pipe, stderr=pipe, text=True)

    return started


@pytest.mark.parametrize(
    ("phase", "number"),
    [
        pytest.param(phase, number, marks=[] if (phase, number) in CASES else pytest.mark.slow)
        for phase in ("import", "load", "train", "score")
        for number in STOPS
    ],
)
def test_signals_that_stop_say_so_and_training_writes_its_checkpoint(begin, tmp_path, phase, number):
    code, _, error = finish(begin(TINY, **{phase: (number,)}))
    assert code == 128 + number, error
    assert "Traceback" not in error and "***" not in error and "to go on: padgs-run protocol=paper" in error
    kept = [path.parent.name for path in tmp_path.glob("runs/*/checkpoint/state.json")]
    assert len(kept) == (phase in ("train", "score"))


def test_signals_without_a_meaning_are_ignored_and_sigusr1_ends_training_early(begin, tmp_path):
    both = (signal.SIGUSR1, signal.SIGUSR2)
    code, out, error = finish(begin(TINY, load=both, train=(signal.SIGUSR2,), score=both, **{"import": both}))
    assert code == 0 and "stopped early" not in out, error
    code, out, error = finish(begin([*TINY, "seed=1"], train=(signal.SIGUSR1,)))
    assert code == 0 and "stopped early, after" in out and "asked to stop and score" in out, error


def test_nohup_keeps_a_run_alive(begin):
    code, _, error = finish(begin(TINY, "nohup", load=(signal.SIGHUP,), train=(signal.SIGHUP,)))
    assert code == 0, error


@pytest.mark.slow
def test_workers_of_a_multirun_write_checkpoints_and_ignore_other_signals(start, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    given = [text for text in TINY if not text.startswith("train.iterations")]
    process = start("-m", *given, "seed=0,1", "launcher=local", "run.jobs=2", "train.iterations=5000")
    wait_for_files(tmp_path, "runs/*/log.jsonl", 2, process)
    for number in (signal.SIGUSR2, signal.SIGHUP):
        process.send_signal(number)
    code, out, error = finish(process)
    assert code == 128 + signal.SIGHUP and "2 stopped" in out and "running jobs wrote their checkpoints" in error
    assert len([*tmp_path.glob("runs/*/checkpoint/state.json")]) == 2


@pytest.mark.slow
def test_a_search_keeps_its_candidates_and_sigusr1_cuts_none_short(start, tmp_path):
    given = [text for text in TINY if not text.startswith(("train.iterations", "data.generator.test_views"))]
    code, _, error = finish(start(*given, "train.iterations=400", "data.generator.test_views=3"))
    assert code == 0, error
    (run,) = (path.parent for path in tmp_path.glob("runs/*/result.json"))
    process = start("smallest", str(run), module="padgs.cli.app")
    wait_for_files(run, "smallest/*/log.jsonl", 1, process)
    process.send_signal(signal.SIGUSR1)
    wait_for_files(run, "smallest/*/result.json", 1, process)
    process.send_signal(signal.SIGHUP)
    code, _, error = finish(process)
    assert code in (0, 128 + signal.SIGHUP) and "Traceback" not in error
    assert not [path for path in run.glob("smallest/*/result.json") if results.read(path).ended]


def wait_for_files(folder: Path, pattern: str, count: int, process: subprocess.Popen) -> None:
    deadline = time.monotonic() + 200
    while len([*folder.glob(pattern)]) < count:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)


CUT = """
import signal, sys

class Cut:
    def find_spec(self, name, path, target=None):
        if name == "torch.nn.functional":  # torch cannot be imported again after this
            try:
                signal.raise_signal(signal.SIGINT)
            except BaseException as error:
                raise ({error}) from error

sys.meta_path.insert(0, Cut())
from {program} import main
main()
"""


@pytest.mark.parametrize("program", ["padgs.multirun.run", pytest.param("padgs.cli.app", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "error",
    [pytest.param("error", marks=pytest.mark.slow), "ImportError('an extension module could not be loaded')"],
)
def test_a_stop_while_extensions_are_imported_is_a_stop(root, program, error):
    command = [sys.executable, "-c", CUT.format(error=error, program=program), "smallest", "nowhere"]
    command[3:] = [] if program == "padgs.multirun.run" else command[3:]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root, timeout=200)
    assert done.returncode == 130 and "Traceback" not in done.stderr and "stopped" in done.stderr


@pytest.mark.parametrize("program", ["padgs.multirun.run", "padgs.cli.app"])
def test_help_for_a_reader_that_has_ended_ends_in_silence(root, program):
    command = f"{sys.executable} -m {program} --help | head -n 1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, cwd=root, timeout=200)
    assert done.stderr == "" and len(done.stdout.splitlines()) == 1


def test_pycolmap_leaves_the_handler_of_sigterm(root):
    pytest.importorskip("pycolmap")
    code = (
        "import os, signal\n"
        "from padgs.runs.interrupt import ending_by_signals\n"
        "with ending_by_signals():\n"
        "    from padgs.data.formats.colmap_lens import pycolmap_module\n"
        "    pycolmap_module()\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=root, timeout=200)
    assert done.returncode == 128 + signal.SIGTERM and done.stderr == "stopped\n"


def test_a_second_ctrl_c_while_threads_end_kills_without_a_traceback():
    code = (
        "import os, signal, sys, threading, time\n"
        "from padgs.runs.interrupt import ending_by_signals\n"
        "threading.Thread(target=lambda: time.sleep(60)).start()\n"
        "with ending_by_signals():\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None and process.stderr.readline() == "stopped\n"
    process.send_signal(signal.SIGINT)
    assert process.wait(30) == -signal.SIGINT and process.stderr.read() == ""
    process.stderr.close()
