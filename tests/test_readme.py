"""Commands in the README and in the pages with commands are understood by their programs; the quick ones are run."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from support.composed import first_and_last_job
from typer.main import get_command

from padgs.cli.commands import app
from padgs.multirun.overrides import missing_plugin
from padgs.reports import REPORTS

ROOT = Path(__file__).resolve().parent.parent
README, QUICKSTART, CONTRIBUTING, *WALKS = (
    (ROOT / name).read_text()
    for name in ("README.md", "docs/quickstart.md", "CONTRIBUTING.md", "docs/cluster.md", "docs/your_photographs.md")
)
TEXT = "".join((README, QUICKSTART, *WALKS))
COMMANDS = [
    line.removeprefix(".venv/bin/")
    for block in re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL)
    for line in block.splitlines()
    if line.strip()
]


def commands(program: str) -> list[str]:
    return [command for command in COMMANDS if command.split()[0] == program]


@pytest.fixture(autouse=True)
def padgs_root(monkeypatch):
    monkeypatch.setenv("PADGS_ROOT", str(ROOT))


def test_every_report_stands_in_its_table():
    rows = re.search(r"\| report \| content \|.*?\n\n", QUICKSTART, re.DOTALL)
    assert rows
    names = [name for row in rows[0].split("\n|")[2:] for name in re.findall(r"`(\w+)`", row.partition("|")[0])]
    assert sorted(names) == sorted(REPORTS)


def test_every_command_is_looked_at_here():
    programs = {command.split()[0] for command in COMMANDS}
    others = {"sh", "podman", "apptainer", "SLURM_CONF=/tmp/padgs-slurm/slurm.conf"}  # of the trials in docs/cluster.md
    assert programs - others == {"make", "pip", "padgs-run", "padgs"}


@pytest.mark.parametrize("command", commands("padgs-run"))
def test_settings_compose(command):
    arguments = [argument for argument in shlex.split(command)[1:] if argument != "-m"]
    if missing_plugin(arguments):
        pytest.skip(missing_plugin(arguments))
    # "init" names a folder of a finished run, which a reader has and this test has not.
    first_choices = [
        re.sub(r"=([^,]*),.*", r"=\1", argument) for argument in arguments if not argument.startswith("init=")
    ]
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
    "path", sorted(set(re.findall(r"`((?:padgs|baselines|conf|reports)/[\w./]*\w\.\w+)`", README + CONTRIBUTING)))
)
def test_files_that_are_named_exist(path):
    assert (ROOT / path).exists() or "yours" in path


@pytest.fixture(scope="module")
def smoke(tmp_path_factory) -> Path:
    """A folder in which the smoke experiment was run."""
    folder = tmp_path_factory.mktemp("smoke")
    assert_runs(folder, "-m", "padgs.multirun.run", "+experiment=smoke", "tracking=none", "run.device=cpu")
    return folder


def assert_runs(folder: Path, *arguments: str) -> str:
    """Run Python in a folder; what it printed."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PADGS_CACHE": str(folder / "cache")}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_smoke_experiment_is_reported(smoke):
    assert "synthetic-room" in assert_runs(smoke, "-m", "padgs.cli.app", "report", "runs")


def test_the_lines_of_python_run(smoke):
    """As written, but on the run of the smoke experiment and a scene that is as small."""
    (lines,) = re.findall(r"```python\n(.*?)```", QUICKSTART, re.DOTALL)
    small = {"train_views": 3, "test_views": 1, "samples": 1, "points": 300, "width": 64}
    run = next((smoke / "runs").glob("*/result.json")).parent
    exchanged = {
        'load_scene("FOLDER", width=512)': f"load_scene(generator={small})",
        "runs/RUN": str(run),
        "iterations=300": "iterations=20",
        "% 100": "% 10",
        "frames=120": "frames=2",
        "cam_from_world)": "scene.train[0].cam_from_world)",
    }
    for written, here in exchanged.items():
        assert lines.count(written) == 1
        lines = lines.replace(written, here)
    checks = "assert picture.image.shape == (32, 64, 3) and len(frames) == 2 and elsewhere.alpha.max() <= 1"
    said = assert_runs(smoke, "-c", f"{lines}\n{checks}")
    assert said.startswith("10 ") and "'ssim'" in said


def test_an_environment_without_pip_is_made_anew(tmp_path):
    """As Debian leaves it where python3-venv is missing: nothing could be installed into it, ever."""
    (tmp_path / "Makefile").write_text((ROOT / "Makefile").read_text())
    for name in ("pyproject.toml", "constraints.txt", "requirements-nodeps.txt", "CMakeLists.txt"):
        (tmp_path / name).touch()
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    for program, does in ((".venv/bin/python", "exit 1"), ("python", 'echo "$@" > asked; exit 3')):
        (tmp_path / program).write_text(f"#!/bin/sh\n{does}\n")
        (tmp_path / program).chmod(0o755)
    done = subprocess.run(["make", "run", "PYTHON=./python"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode and (tmp_path / "asked").read_text() == "-m venv .venv\n"
    assert "Error 3" in done.stderr, "nothing else is tried where there is no environment"


def test_what_is_missing_is_installed_for_the_python_that_misses_it(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr(sys, "executable", "/my place/python")
    assert "'/my place/python' -m pip install 'padgs[launchers]'" in str(missing_plugin(["launcher=slurm"]))


def test_extras_are_installed_without_compiling_again():
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        commands = re.findall(r"""pip install[^`\n]*-e ["']\.\[(?:view|video|mlflow|ray)\b""", page.read_text())
        assert not commands, page


def test_links_between_pages_and_to_files_exist():
    pages = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md"))
    links = {(page, link) for page in pages for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())}
    missing = [f"{page}: {link}" for page, link in links if "://" not in link and not (page.parent / link).exists()]
    assert links and sorted(missing) == []


def test_texts_are_short():
    pages = [page for page in (ROOT / "docs").glob("*.md") if page.name != "findings.md"]  # which is made from runs
    most = {ROOT / "README.md": 1200, **dict.fromkeys(pages, 1500)}
    words = {page.name: len(page.read_text().split()) for page in most}
    assert {page.name: words[page.name] for page, limit in most.items() if words[page.name] > limit} == {}
