"""Checks and spacing of the initial points, and the extent of the cameras."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.checks import check
from padgs.scene import Scene

NEIGHBOURS = 3  # nearest neighbours in the mean spacing, as 3DGS


def refuse_unusable(points: Tensor, what: str) -> None:
    """Refuse points [N, 3] that no model can start from: none, or not finite; `what` names the models."""
    if len(points) == 0:
        raise ValueError(f"the point cloud is empty; {what} start from points, so the scene needs at least one")
    if not torch.isfinite(points).all():
        bad = int((~torch.isfinite(points).all(-1)).nonzero()[0])
        raise ValueError(f"point {bad} of the cloud is {points[bad].tolist()}; remove points that are not finite")


def squared_spacing(points: Tensor) -> Tensor | None:
    """Return the mean square distance [N] of points [N, 3] to the three nearest others, float64; None for one point."""
    from scipy.spatial import KDTree

    if (neighbours := min(NEIGHBOURS, len(points) - 1)) < 1:
        return None
    xyz = points.detach().double().cpu().numpy()
    distances, _ = KDTree(xyz).query(xyz, k=neighbours + 1)  # the first neighbour is the point itself
    return torch.from_numpy(distances[:, 1:]).square().mean(-1)


@dataclass(frozen=True)
class ExtentOptions:
    """Options of methods whose learning rates and densification scale with the extent of the cameras."""

    min_extent: float = 0.1  # lower bound in scene scales, for cameras that hardly move; 0: as published

    def __post_init__(self) -> None:
        check(self, "a length >= 0 in scene scales", lambda least: 0 <= least < math.inf, "min_extent")

    def extent_of(self, scene: Scene) -> float:
        """Return the extent of the training cameras of a scene, world units; 0 is refused."""
        if scene.has_single_center and self.min_extent == 0:
            raise ValueError(
                f"the training cameras of scene {scene.name!r} stand in one place, so their extent is 0 and no "
                "Gaussian would ever move; set method.min_extent to a share of the scene scale, such as 0.1"
            )
        return max(scene.extent, self.min_extent * scene.scale)
