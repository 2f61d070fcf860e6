"""Registry of the compared methods; other packages add methods by entry points, see docs/your_own_method."""

from importlib.metadata import entry_points

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
    """Return name and version of the package that provides a method; empty for a built-in one."""
    points = () if method in BUILT_IN else entry_points(group=GROUP, name=method)
    return " ".join(f"{point.dist.name} {point.dist.version}" for point in points if point.dist)


METHODS |= {name: value for name, value in outside().items() if name not in BUILT_IN}
