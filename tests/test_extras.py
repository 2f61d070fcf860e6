"""Whoever lacks an extra is told a command that installs it where it is missing."""

import re
import sys

from padgs.multirun.overrides import missing_plugin


def test_what_is_missing_is_installed_for_the_python_that_misses_it(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setattr(sys, "executable", "/my place/python")
    assert "'/my place/python' -m pip install 'padgs[launchers]'" in str(missing_plugin(["launcher=slurm"]))


def test_extras_are_installed_without_compiling_again(root):
    for page in (root / "README.md", *(root / "docs").glob("*.md")):
        commands = re.findall(r"""pip install[^`\n]*-e ["']\.\[(?:view|video|mlflow|ray)\b""", page.read_text())
        assert not commands, page
