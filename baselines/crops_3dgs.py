"""3DGS (Kerbl et al. 2023) on overlapping perspective crops of the panoramas, all with one lens.

Twelve crops look along the vertices of an icosahedron, none along the vertical axis of the panorama. They overlap, so
that every direction is inside some crop.
"""

from __future__ import annotations

import math

from torch import Tensor

from padgs.baselines.cubemap_3dgs import Cubemap3DGSMethod
from padgs.data.perspectives import looking_at, square_lens
from padgs.geometry.camera import Panorama, Pinhole
from padgs.render.cubemap import FINENESS

GOLDEN = (1 + math.sqrt(5)) / 2
ICOSAHEDRON = [
    vertex for a in (1.0, -1.0) for b in (GOLDEN, -GOLDEN) for vertex in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))
]
# Degrees across each square crop. Below 74.75, twice the angle between a vertex and the centre of a face, crops would
# not cover the sphere.
FIELD_OF_VIEW = 75.0


class Crops3DGSMethod(Cubemap3DGSMethod):
    """See `padgs.training.method.Method`."""

    def turns(self) -> Tensor:
        """Return rotations [12, 3, 3] from the camera frame of a panorama to those of the crops."""
        return looking_at(ICOSAHEDRON)

    def lens(self, panorama: Panorama) -> Pinhole:
        """Return the camera of the crops."""
        return square_lens(panorama, math.tan(math.radians(FIELD_OF_VIEW / 2)), FINENESS)
