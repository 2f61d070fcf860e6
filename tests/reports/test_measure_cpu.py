"""reports/measure_cpu.sh: its plan, and with fake programs how it resumes and what it refuses."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import pytest

from padgs.multirun.composition import composing, configuration, multirun
from padgs.multirun.overrides import expand

SCRIPT = Path(__file__).parents[2] / "reports" / "measure_cpu.sh"
STEPS = ["A", "C", "L", "D", "E", "F", "G", "J"]
FAKE = """#!/bin/bash
echo "$*" >> "$CALLS"
for setting; do case $setting in run.folder=*) runs=${setting#*=} ;; esac; done
mkdir "$runs/$$"
echo "{\\"commit\\": \\"${FORGED:-$(git rev-parse HEAD)}\\"}" > "$runs/$$/result.json"
if [ -n "$WAIT" ]; then sleep "$WAIT"; fi
echo "3 of 4 done, ${FAILED:-1 failed (nan)}"
exit ${STATUS:-1}
"""


@pytest.fixture
def measure(tmp_path, monkeypatch):
    """Run the script in a repository of its own; return its exit code, its output and its calls of padgs-run."""
    for folder in ("reports", "bin"):
        (tmp_path / folder).mkdir()
    shutil.copy(SCRIPT, tmp_path / "reports")
    for name, text in {"padgs-run": FAKE, "padgs": '#!/bin/bash\necho "$*" >> "$CALLS"\n'}.items():
        (tmp_path / "bin" / name).write_text(text)
        (tmp_path / "bin" / name).chmod(0o755)
    (tmp_path / ".gitignore").write_text("build\n")
    calls = tmp_path / "build" / "calls"
    calls.parent.mkdir()

    def git(*arguments: str) -> None:
        identity = ("-c", "user.name=a", "-c", "user.email=a@b")
        subprocess.run(["git", "-C", str(tmp_path), *identity, *arguments], check=True)

    def run(*arguments: str, **variables: str) -> tuple[int, str, list[str]]:
        for name, value in {"BIN": "bin", "CALLS": str(calls), **variables}.items():
            monkeypatch.setenv(name, value)
        calls.write_text("")
        done = subprocess.run([tmp_path / "reports" / SCRIPT.name, *arguments], capture_output=True, text=True)
        for name in variables:
            monkeypatch.delenv(name)
        return done.returncode, done.stdout + done.stderr, calls.read_text().splitlines()

    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "first")
    run.commit = lambda: git("commit", "-q", "--allow-empty", "-m", "second")
    return run


def test_the_plan_names_every_step_and_starts_nothing(measure):
    code, output, calls = measure("--plan")
    assert (code, calls) == (0, [])
    assert all(f"{table}-" in output for table in STEPS) and "left: 28 steps, about " in output


def test_finished_steps_are_skipped_and_the_tables_come_last(measure):
    assert measure("E-court", "--small")[0] == 0
    code, output, calls = measure("E", "--small")
    assert code == 0 and "E-court            14       0.0 done" in output
    assert len(calls) == 4 and all("+scene=synthetic_room" in call and "run.threads=1" in call for call in calls[:3])
    assert calls[3].startswith("report all build/campaign-small/runs --strict --collect")


def test_a_stopped_step_is_resumed_and_one_without_all_results_tried_again(measure):
    code, output, calls = measure("J-court", STATUS="130")
    assert (code, len(calls)) == (130, 1) and "the same command resumes" in output
    code, output, calls = measure("J-court", FAILED="1 failed (refused)")
    assert (code, len(calls)) == (1, 1) and "runs without a result in J-court" in output
    assert measure("J-court")[0] == 0


def test_a_signal_to_the_script_alone_ends_its_runs_and_it_resumes(measure, tmp_path):
    settings = {**os.environ, "BIN": "bin", "CALLS": str(tmp_path / "build/calls"), "WAIT": "60"}
    script = tmp_path / "reports" / SCRIPT.name
    in_background = ["bash", "-c", 'trap "" INT; exec "$0" J-court', script]  # `&` of a script ignores Ctrl-C
    started = subprocess.Popen(in_background, env=settings, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    while started.poll() is None and not list(tmp_path.glob("build/campaign/runs/*/result.json")):
        time.sleep(0.05)
    started.terminate()
    output, _ = started.communicate(timeout=30)
    assert started.returncode == 130 and b"the same command resumes" in output
    code, output, calls = measure("J-court")
    assert (code, len(calls)) == (0, 2), output


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="no /proc to find processes in")
def test_what_a_killed_campaign_left_running_does_not_block_the_next_one(measure, tmp_path):
    settings = {**os.environ, "BIN": "bin", "CALLS": str(tmp_path / "build/calls"), "WAIT": "8"}
    script = [tmp_path / "reports" / SCRIPT.name, "J-court"]
    started = subprocess.Popen(script, env=settings, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not list(tmp_path.glob("build/campaign/runs/*/result.json")):
        time.sleep(0.05)
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if str(script[0]).encode() in (process / "cmdline").read_bytes():  # not the runs, which go on
                os.kill(int(process.name), signal.SIGKILL)
    started.wait(30)
    code, output, calls = measure("J-court")
    assert (code, len(calls)) == (0, 2), output


def test_another_commit_or_sitting_or_a_changed_file_is_refused(measure, tmp_path):
    assert measure("J-court")[0] == 0
    sitting = tmp_path / "build/campaign/J-flat.sitting"
    sitting.write_text((tmp_path / "build/campaign/J-court.sitting").read_text().replace(", ", ", another ", 1))
    code, output, calls = measure("J-flat")
    assert (code, calls) == (1, []) and "J-flat was begun in another sitting" in output
    sitting.unlink()
    code, output, _ = measure("J-flat", FORGED="1234")
    assert code == 1 and "of another commit" in output
    measure.commit()
    code, output, calls = measure("J-bedroom")
    assert (code, calls) == (1, []) and "was measured at commit" in output
    (tmp_path / ".gitignore").write_text("build\n# changed\n")
    code, output, calls = measure("J-bedroom")
    assert (code, calls) == (1, []) and "files differ from the commit" in output


def test_unknown_steps_and_options_are_refused(measure):
    assert measure("K", "--plan")[:2] == (1, measure("K")[1]) and "there is no step K" in measure("K")[1]
    assert "--plann is no option" in measure("--plann")[1]


def test_every_command_can_be_composed_and_has_as_many_jobs_as_the_plan_says(measure):
    _, output, calls = measure("D", "E", "F", "G", "J", "A-bedroom", "C-bedroom", "L-bedroom")
    commands = {call.split(" data.path")[0].split(" +scene")[0]: call for call in calls[:-1]}
    lines = [line.split() for line in output[: output.index("left: ")].splitlines()[1:]]
    planned = {step: int(runs) for step, runs, *_ in lines}
    assert len(commands) == 15
    jobs = 0
    with composing() as loader:
        for call in commands.values():
            settings = call.removesuffix(" launcher=local run.jobs=2").split()
            config = multirun(settings)
            expansion = expand(config.hydra.sweeper.params or {}, config.hydra.overrides.task, loader)
            jobs += len(expansion)
            configuration(expansion[0])
    scenes = ("A-bedroom", "C-bedroom", "L-bedroom", "D-bedroom", "E-bedroom", "F-bedroom", "G-builtin", "J-bedroom")
    assert jobs == sum(planned[step] for step in scenes)
