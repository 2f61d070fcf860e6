"""A method of another package, as docs/your_own_method has one: found by its entry point, and as good as ours."""

import importlib
import inspect
import os
import subprocess
import sys
from configparser import ConfigParser

import pytest
from support.fixtures import make_world, write_images
from support.tiny_scene import tiny_scene

import padgs
from padgs import baselines
from padgs.baselines import METHODS, clash, distribution, outside
from padgs.multirun.composition import register_choices
from padgs.reports import methods
from padgs.runs.config import config_from_values
from padgs.runs.run import initial_result


@pytest.fixture
def installed(root, tmp_path, monkeypatch):
    """The folder of the example as if pip had installed it: importable, and with the entry points that it states."""
    folder = root / "docs" / "your_own_method"
    stated = ConfigParser()
    stated.read(folder / "pyproject.toml")
    groups = ("padgs.methods", "padgs.datasets")
    points = {group: stated[f'project.entry-points."{group}"'].items() for group in groups}
    lines = [f"[{group}]\n{name} = {value}" for group, ((name, value),) in points.items()]
    information = tmp_path / "my_method-0.1.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: my-method\nVersion: 0.1\n")
    (information / "entry_points.txt").write_text("\n".join(lines).replace('"', ""))
    for path in (folder, folder / "tests", tmp_path):
        monkeypatch.syspath_prepend(path)
    for name, value in outside().items():
        monkeypatch.setitem(METHODS, name, value)
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path / "cache"))
    yield importlib.import_module("test_my_method")
    for module in ("my_method", "my_reader", "test_my_method"):
        sys.modules.pop(module, None)


def test_tests_of_the_example_method_pass(installed, tmp_path):
    assert "my_method" in METHODS
    scene = padgs.load_scene(generator=installed.ROOM)
    promises = [test for name, test in inspect.getmembers(installed) if name.startswith("test_")]
    for promise in promises:
        wanted = {"scene": scene, "tmp_path": tmp_path / "checkpoint"}
        promise(**{name: wanted[name] for name in inspect.signature(promise).parameters})
    assert len(promises) == 4


def test_a_method_that_counts_no_gaussians_refuses_to_limit_and_to_prune_them(installed):
    method = padgs.make_method("my_method")
    with pytest.raises(ValueError, match="budget.gaussians is 100, but My has no Gaussians; leave it out"):
        method.refuse_budget(padgs.Budget(10, gaussians=100))
    with pytest.raises(ValueError, match="My has no Gaussians to prune, so it has no smallest model"):
        method.refuse_search()


def test_a_format_of_another_package_is_read_by_its_name(installed, root, tmp_path):
    folder, world = tmp_path / "capture", make_world()
    write_images(world, folder / "images")
    with (folder / "poses.csv").open("w") as file:
        file.write("name,qw,qx,qy,qz,x,y,z\n")
        for index, name in enumerate(world.names):
            file.write(f"{name}.png,1,0,0,0,{index},0,0\n")
    code = "import padgs, sys; print(*padgs.load_scene(sys.argv[1], format='my_format').notes, sep='\\n')"
    places = os.pathsep.join((str(root / "docs/your_own_method"), str(tmp_path)))
    command, environment = [sys.executable, "-c", code, folder], {**os.environ, "PYTHONPATH": places}
    done = subprocess.run(command, env=environment, text=True, capture_output=True)
    assert done.returncode == 0 and "format: my_format, read by my-method 0.1" in done.stdout, done.stderr


def test_names_of_built_in_methods_are_refused(installed, monkeypatch):
    assert clash() is None
    monkeypatch.setattr(baselines, "BUILT_IN", baselines.BUILT_IN | {"my_method"})
    assert clash() == "entry point my_method:MyMethod has the name my_method of a built-in method; rename it"


BROKEN = {
    "no_such_module:Method": "ModuleNotFoundError: No module named 'no_such_module'",
    "ends:Method": "SystemExit: 3",
    "raises:Method": "ZeroDivisionError: division by zero",
    "empty:Method": "AttributeError: module 'empty' has no attribute 'Method'",
    "options:Method": "SystemExit: 4",
}


@pytest.fixture
def broken(tmp_path, monkeypatch):
    """Modules that end the program, or raise, when they are imported or asked for their options."""
    (tmp_path / "ends.py").write_text("import sys; sys.exit(3)")
    (tmp_path / "raises.py").write_text("1 / 0")
    (tmp_path / "empty.py").write_text("")
    (tmp_path / "options.py").write_text("import sys\nclass Method:\n    def Options(): sys.exit(4)\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield
    for name in ("ends", "raises", "empty", "options"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("place", BROKEN)
def test_methods_that_fail_are_skipped_with_one_warning(broken, place, monkeypatch, capsys):
    monkeypatch.setitem(METHODS, "broken", place)
    for _ in range(2):
        register_choices()
    said = capsys.readouterr().err
    assert said.count("method=broken is left out (") == 1 and BROKEN[place] in said
    assert "broken" not in METHODS


@pytest.mark.parametrize("place", [place for place in BROKEN if not place.startswith("options")])
def test_runs_of_methods_that_fail_say_so_by_name(broken, place, monkeypatch):
    monkeypatch.setitem(METHODS, "broken", place)
    with pytest.raises(ValueError, match=f"method broken cannot be used: {place} of another package fails"):
        config_from_values({"method": {"name": "broken"}, "protocol": {"paper": {}}})


def test_results_say_which_package_they_are_of(installed, tmp_path, monkeypatch):
    config = config_from_values({"method": {"name": "my_method"}, "protocol": {"paper": {}}})
    before = initial_result(config, tiny_scene(), "run").code_version
    assert " my-method 0.1 " in before
    (tmp_path / "my_method.py").write_text(f"{inspect.getsource(sys.modules['my_method'])}# changed")
    monkeypatch.delitem(sys.modules, "my_method")
    importlib.invalidate_caches()
    assert initial_result(config, tiny_scene(), "run").code_version != before, "the same version, other code"
    assert distribution("padgs") == ""
    assert (methods.title("my_method"), methods.color("my_method")) == ("My method", "#8a5a2b")
