"""3DGS (Kerbl et al. 2023) on overlapping perspective crops of the panoramas, all with one lens.

Twelve crops look along the vertices of an icosahedron, none along the vertical axis of the panorama. They overlap, so
that every direction is inside some crop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from padgs.baselines.cubemap_3dgs import Cubemap3DGSMethod
from padgs.data.perspectives import looking_at, square_lens
from padgs.geometry.camera import Panorama, Pinhole
from padgs.methods.splats.method import SplatOptions
from padgs.render.cubemap import FINENESS

GOLDEN = (1 + math.sqrt(5)) / 2
ICOSAHEDRON = [
    vertex for a in (1.0, -1.0) for b in (GOLDEN, -GOLDEN) for vertex in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))
]
# Twice the angle between a vertex and the centre of a face: narrower crops do not cover the sphere.
MIN_FIELD_OF_VIEW = 2 * math.degrees(math.acos(math.sqrt((5 + 2 * math.sqrt(5)) / 15)))


@dataclass(frozen=True)
class Crops3DGSOptions(SplatOptions):
    """The `method` group of the configuration."""

    field_of_view: float = 75.0  # degrees across each square crop

    def __post_init__(self) -> None:
        super().__post_init__()
        if not MIN_FIELD_OF_VIEW <= self.field_of_view < 180:
            raise ValueError(
                f"field_of_view is {self.field_of_view}; it must be less than 180, and at least "
                f"{MIN_FIELD_OF_VIEW:.2f} degrees for the crops to cover the sphere"
            )


class Crops3DGSMethod(Cubemap3DGSMethod):
    """See `padgs.training.method.Method`."""

    Options = Crops3DGSOptions

    def turns(self) -> Tensor:
        """Return rotations [12, 3, 3] from the camera frame of a panorama to those of the crops."""
        return looking_at(ICOSAHEDRON)

    def lens(self, panorama: Panorama) -> Pinhole:
        """Return the camera of the crops."""
        return square_lens(panorama, math.tan(math.radians(self.options.field_of_view / 2)), FINENESS)
