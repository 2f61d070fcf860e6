"""A method of another package, as docs/your_own_method has one: found by its entry point, and as good as ours."""

import importlib
import inspect
import sys
from configparser import ConfigParser

import pytest

import padgs
from padgs.baselines import METHODS, outside


@pytest.fixture
def installed(root, tmp_path, monkeypatch):
    """The folder of the example as if pip had installed it: importable, and with the entry points that it states."""
    folder = root / "docs" / "your_own_method"
    stated = ConfigParser()
    stated.read(folder / "pyproject.toml")
    (point,) = stated['project.entry-points."padgs.methods"'].items()
    information = tmp_path / "my_method-0.1.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: my-method\nVersion: 0.1\n")
    (information / "entry_points.txt").write_text("[padgs.methods]\n{} = {}".format(*point).replace('"', ""))
    for path in (folder, tmp_path):
        monkeypatch.syspath_prepend(path)
    for name, value in outside().items():
        monkeypatch.setitem(METHODS, name, value)
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path / "cache"))
    yield importlib.import_module("test_my_method")
    for module in ("my_method", "test_my_method"):
        sys.modules.pop(module, None)


@pytest.mark.slow
def test_it_keeps_the_promises_that_its_own_tests_state(installed, tmp_path):
    assert "my_method" in METHODS
    scene = padgs.load_scene(generator=installed.ROOM)
    promises = [test for name, test in inspect.getmembers(installed) if name.startswith("test_")]
    for promise in promises:
        wanted = {"scene": scene, "tmp_path": tmp_path / "checkpoint"}
        promise(**{name: wanted[name] for name in inspect.signature(promise).parameters})
    assert len(promises) == 4


def test_a_name_of_ours_is_refused(installed, monkeypatch):
    monkeypatch.setitem(METHODS, "my_method", "padgs.baselines.omnigs:OmniGSMethod")
    with pytest.raises(ValueError, match="my_method:MyMethod is called my_method, as a method of padgs is"):
        outside()
