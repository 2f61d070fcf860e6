"""What a run may lose under a condition and still have survived it: how much worse a mark may become at each level.

Conditions without a limit have none to hold: what they cost is shown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

MADE_FOR = ("256x128", 1500)  # resolution, and iterations without stress


@dataclass(frozen=True)
class Limit:
    """How far a mark of the protocol `stability` may go at each level from 1 on, as far as there is a limit."""

    levels: tuple[float, ...]
    mark: str = "ws_psnr"
    lost: bool = True  # against the same run without the condition, which has more; otherwise what it has itself


LIMITS: Mapping[str, Limit] = {
    "world_rotation": Limit((0.2, 0.3, 0.5)),
    "seam": Limit((1.1, 1.1, 1.1), "seam", lost=False),
    "world_scale": Limit((0.1, 0.1, 0.1)),
    "near_points": Limit((0.5, 0.5, 0.5)),
    "few_points": Limit((0.5, 1.5, 4.0)),
    "random_points": Limit((2.0, 3.0, 5.0)),
    "outlier_points": Limit((0.2, 0.5, 1.0)),
    "pose_noise": Limit((0.5, 2.0, 6.0)),
    "pose_rotation": Limit((0.5, 3.0, 8.0)),
    "textureless": Limit((0.1, 0.15, 0.3), "depth_error", lost=False),
    "exposure": Limit((0.5, 1.5, 3.0), "ws_psnr_fitted"),
    "resolution": Limit((2.0,)),
    "schedule": Limit((0.1, 0.1, 0.1)),
    "precision": Limit((0.05, 0.05)),
}
