"""The extent: the length by which methods measure that were made for cameras that travel."""

from __future__ import annotations

import math
from dataclasses import dataclass

from padgs.checks import check
from padgs.scene import Scene


@dataclass(frozen=True)
class ExtentOptions:
    """Options of such methods. The published extent is that of `Scene.extent`, which may be next to nothing."""

    min_extent: float = 0.1  # units of the scene it is at least, for cameras that hardly move; 0: as published

    def __post_init__(self) -> None:
        check(self, "a length >= 0 in units of the scene", lambda least: 0 <= least < math.inf, "min_extent")

    def extent_of(self, scene: Scene) -> float:
        """The extent of the training cameras of a scene, world units.

        Raises:
            ValueError: nothing is left of it, because they stand in one place.
        """
        if scene.has_single_center and self.min_extent == 0:
            raise ValueError(
                f"the training cameras of scene {scene.name!r} stand in one place, so their extent is 0 and no "
                "Gaussian would ever move; set method.min_extent to a share of the scene's unit, such as 0.1"
            )
        return max(scene.extent, self.min_extent * scene.scale)
