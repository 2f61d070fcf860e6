"""The methods that are compared, one file each; PaD-GS, which they are compared with, has a room (padgs/anchors).

Packages elsewhere add theirs by entry points, see docs/your_own_method.
"""

from importlib.metadata import entry_points

METHODS = {
    "padgs": "padgs.anchors.method:PaDGSMethod",
    "omnigs": "padgs.baselines.omnigs:OmniGSMethod",
    "odgs": "padgs.baselines.odgs:ODGSMethod",
    "op43dgs": "padgs.baselines.op43dgs:OP43DGSMethod",
    "spags": "padgs.baselines.spags:SPaGSMethod",
    "cubemap_3dgs": "padgs.baselines.cubemap_3dgs:Cubemap3DGSMethod",
    "crops_3dgs": "padgs.baselines.crops_3dgs:Crops3DGSMethod",
    "egonerf": "padgs.baselines.egonerf:EgoNeRFMethod",
    "sc_omnigs": "padgs.baselines.sc_omnigs:SCOmniGSMethod",
    "seam360gs": "padgs.baselines.seam360gs:Seam360GSMethod",
    "padgs_plus": "padgs.plus.method:PlusMethod",
}


def outside() -> dict[str, str]:
    """The methods of other packages, name -> "package.module:class": entry points of the group padgs.methods.

    Raises:
        ValueError: one has a name of ours.
    """
    found = {point.name: point.value for point in entry_points(group="padgs.methods")}
    if taken := sorted(found.keys() & METHODS.keys()):
        raise ValueError(f"entry point {found[taken[0]]} is called {taken[0]}, as a method of padgs is; rename it")
    return found


METHODS |= outside()
