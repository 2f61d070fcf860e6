"""Comparison of renders with the ground truth: metrics, protocols, evaluation."""

BANDS = {  # degrees of latitude, [from, to); down is positive. Here, because it can be imported without torch.
    "equator": ((-30, 30),),
    "middle": ((-60, -30), (30, 60)),
    "high": ((-75, -60), (60, 75)),
    "pole": ((-90, -75), (75, 90)),
    "zenith": ((-90, -75),),
    "nadir": ((75, 90),),
}
