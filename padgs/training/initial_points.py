"""The points that models start from: whether they can be used, and how dense they are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.checks import check
from padgs.scene import Scene

NEIGHBOURS = 3  # distances that say how dense points are


def refuse_unusable(points: Tensor, what: str) -> None:
    """Refuse points [N, 3] that nothing can start from; `what` would, in words.

    Raises:
        ValueError: there are none, or one is not finite.
    """
    if len(points) == 0:
        raise ValueError(f"the point cloud is empty; {what} start from points, so the scene needs at least one")
    if not torch.isfinite(points).all():
        bad = int((~torch.isfinite(points).all(-1)).nonzero()[0])
        raise ValueError(f"point {bad} of the cloud is {points[bad].tolist()}; remove points that are not finite")


def squared_spacing(points: Tensor) -> Tensor | None:
    """Mean square distance [N] of each point [N, 3] to its three nearest others, float64 on the CPU.

    None of a lone point. Points that coincide are 0 apart.
    """
    from scipy.spatial import KDTree

    neighbours = min(NEIGHBOURS, len(points) - 1)
    if neighbours < 1:
        return None
    xyz = points.detach().double().cpu().numpy()
    distances, _ = KDTree(xyz).query(xyz, k=neighbours + 1)  # the first is the point itself, or one that coincides
    return torch.from_numpy(distances[:, 1:]).square().mean(-1)


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
