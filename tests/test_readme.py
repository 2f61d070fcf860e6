"""Every command in README and docs/cluster.md is understood by the program it names; the quick ones are run."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from composed import first_and_last_job
from typer.main import get_command

from padgs.cli.app import app
from padgs.multirun.launchers import missing_plugin

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()
TEXT = README + (ROOT / "docs" / "cluster.md").read_text()
COMMANDS = [
    line for block in re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL) for line in block.splitlines() if line.strip()
]


def commands(program: str) -> list[str]:
    return [command for command in COMMANDS if command.split()[0] == program]


@pytest.fixture(autouse=True)
def padgs_root(monkeypatch):
    monkeypatch.setenv("PADGS_ROOT", str(ROOT))


def test_every_command_is_looked_at_here():
    assert {command.split()[0] for command in COMMANDS} == {"make", "pip", "padgs-run", "padgs"}


@pytest.mark.parametrize("command", commands("padgs-run"))
def test_settings_compose(command):
    arguments = [argument for argument in shlex.split(command)[1:] if argument != "-m"]
    if missing_plugin(arguments):
        pytest.skip(missing_plugin(arguments))
    first_choices = [re.sub(r"=([^,]*),.*", r"=\1", argument) for argument in arguments]
    assert first_and_last_job(*first_choices)


@pytest.mark.parametrize("command", commands("padgs"))
def test_options_exist(command):
    name, *arguments = shlex.split(command)[1:]
    get_command(app).commands[name].make_context(name, arguments)


@pytest.mark.parametrize("command", commands("make"))
def test_targets_exist(command):
    done = subprocess.run([*shlex.split(command), "-n"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("command", commands("pip"))
def test_requirement_files_exist(command):
    words = shlex.split(command)
    files = [words[index + 1] for index, word in enumerate(words) if word in ("-c", "-r")]
    assert files and all((ROOT / file).is_file() for file in files)


@pytest.mark.parametrize(
    "path", sorted(set(re.findall(r"`((?:padgs|baselines|conf|reports)/[\w./]*\w\.\w+)`", README)))
)
def test_files_that_are_named_exist(path):
    assert (ROOT / path).exists() or "yours" in path


@pytest.mark.slow
def test_the_smoke_experiment_runs_and_is_reported(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    for module, arguments in (("multirun.run", ["+experiment=smoke"]), ("cli.app", ["report", "runs"])):
        command = [sys.executable, "-m", f"padgs.{module}", *arguments]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
    assert "synthetic-room" in done.stdout
