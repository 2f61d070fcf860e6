"""The methods that are compared, one file each; PaD-GS, which they are compared with, has a room (padgs/anchors)."""

METHODS = {
    "padgs": "padgs.anchors.method:PaDGSMethod",
    "omnigs": "baselines.omnigs:OmniGSMethod",
    "odgs": "baselines.odgs:ODGSMethod",
    "op43dgs": "baselines.op43dgs:OP43DGSMethod",
    "spags": "baselines.spags:SPaGSMethod",
    "cubemap_3dgs": "baselines.cubemap_3dgs:Cubemap3DGSMethod",
    "crops_3dgs": "baselines.crops_3dgs:Crops3DGSMethod",
    "egonerf": "baselines.egonerf:EgoNeRFMethod",
    "sc_omnigs": "baselines.sc_omnigs:SCOmniGSMethod",
    "seam360gs": "baselines.seam360gs:Seam360GSMethod",
    "padgs_plus": "padgs.plus.method:PlusMethod",
}
