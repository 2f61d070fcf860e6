"""Registry of the compared methods; other packages add methods by entry points, see docs/your_own_method."""

import hashlib
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

METHODS = {
    "padgs": "padgs.methods.anchors.method:PaDGSMethod",
    "omnigs": "padgs.baselines.omnigs:OmniGSMethod",
    "odgs": "padgs.baselines.odgs:ODGSMethod",
    "op43dgs": "padgs.baselines.op43dgs:OP43DGSMethod",
    "spags": "padgs.baselines.spags:SPaGSMethod",
    "cubemap_3dgs": "padgs.baselines.perspective_3dgs:Cubemap3DGSMethod",
    "crops_3dgs": "padgs.baselines.perspective_3dgs:Crops3DGSMethod",
    "egonerf": "padgs.baselines.egonerf:EgoNeRFMethod",
    "sc_omnigs": "padgs.baselines.sc_omnigs:SCOmniGSMethod",
    "seam360gs": "padgs.baselines.seam360gs:Seam360GSMethod",
    "padgs_plus": "padgs.methods.plus.method:PlusMethod",
}
BUILT_IN = frozenset(METHODS)
GROUP = "padgs.methods"  # of entry points


def outside() -> dict[str, str]:
    """Return the methods of other packages, name -> "package.module:class", from entry points of padgs.methods."""
    return {point.name: point.value for point in entry_points(group=GROUP)}


def clash() -> str | None:
    """Return an error message if another package uses the name of a built-in method, else None."""
    found = outside()
    if taken := sorted(found.keys() & BUILT_IN):
        return f"entry point {found[taken[0]]} has the name {taken[0]} of a built-in method; rename it"
    return None


def distribution(method: str) -> str:
    """Return name, version and a digest of the code of the package that provides a method; empty for a built-in one.

    A package that is being written changes without its version.
    """
    points = () if method in BUILT_IN else entry_points(group=GROUP, name=method)
    return " ".join(f"{point.dist.name} {point.dist.version} {_code(point.module)}" for point in points if point.dist)


def _code(module: str) -> str:
    """Return a digest of the Python files of a module's top-level package, which is not imported."""
    spec = find_spec(module.partition(".")[0])
    folders = [Path(folder) for folder in (spec and spec.submodule_search_locations) or ()]
    files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
    files = files or [Path(spec.origin)] if spec and spec.origin else files
    return hashlib.sha256(b"".join(file.read_bytes() for file in files if file.is_file())).hexdigest()[:8]


METHODS |= {name: value for name, value in outside().items() if name not in BUILT_IN}
