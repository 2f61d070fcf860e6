"""Bands of latitude that are scored apart. Without torch, for those who only tell what a number means."""

BANDS = {  # degrees of latitude, [from, to); down is positive
    "equator": ((-30, 30),),
    "middle": ((-60, -30), (30, 60)),
    "high": ((-75, -60), (60, 75)),
    "pole": ((-90, -75), (75, 90)),
    "zenith": ((-90, -75),),
    "nadir": ((75, 90),),
}
