"""Registry of the compared methods, one file each; PaD-GS and padgs_plus are packages of `padgs.methods`.

Other packages add methods by entry points, see docs/your_own_method.
"""

from importlib.metadata import entry_points

METHODS = {
    "padgs": "padgs.methods.anchors.method:PaDGSMethod",
    "omnigs": "padgs.baselines.omnigs:OmniGSMethod",
    "odgs": "padgs.baselines.odgs:ODGSMethod",
    "op43dgs": "padgs.baselines.op43dgs:OP43DGSMethod",
    "spags": "padgs.baselines.spags:SPaGSMethod",
    "cubemap_3dgs": "padgs.baselines.cubemap_3dgs:Cubemap3DGSMethod",
    "crops_3dgs": "padgs.baselines.crops_3dgs:Crops3DGSMethod",
    "egonerf": "padgs.baselines.egonerf:EgoNeRFMethod",
    "sc_omnigs": "padgs.baselines.sc_omnigs:SCOmniGSMethod",
    "seam360gs": "padgs.baselines.seam360gs:Seam360GSMethod",
    "padgs_plus": "padgs.methods.plus.method:PlusMethod",
}
OURS = frozenset(METHODS)
GROUP = "padgs.methods"  # of entry points


def outside() -> dict[str, str]:
    """The methods of other packages, name -> "package.module:class": entry points of the group padgs.methods."""
    return {point.name: point.value for point in entry_points(group=GROUP)}


def clash() -> str | None:
    """What is wrong where another package calls a method as we call one of ours; None if none does."""
    found = outside()
    if taken := sorted(found.keys() & OURS):
        return f"entry point {found[taken[0]]} is called {taken[0]}, as a method of padgs is; rename it"
    return None


def distribution(method: str) -> str:
    """Name and version of the package that brings a method; empty for one of ours."""
    points = () if method in OURS else entry_points(group=GROUP, name=method)
    return " ".join(f"{point.dist.name} {point.dist.version}" for point in points if point.dist)


METHODS |= {name: value for name, value in outside().items() if name not in OURS}
