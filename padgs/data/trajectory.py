"""What the poses of a capture tell: which way is up, how far the camera went, how far away things are."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Gravity:
    """The direction that the cameras agree to call up, in the world frame."""

    up: tuple[float, float, float]
    agreement: float  # length of the mean of the cameras' up directions: 1 = all level, 0 = no common direction
    axis: str  # the world axis nearest to it: +x, -x, ...
    off_axis: float  # degrees between the two
    tilt: float  # degrees, median angle of a camera's own up to the common one


def gravity(poses: Tensor) -> Gravity:
    """Up of the world from cam_from_world [F, 4, 4]: panoramic cameras are mostly upright, so -y averages to up."""
    ups = -poses[:, 1, :3]  # the camera's -y in the world: minus the second row of the rotation
    mean = ups.mean(0)
    up = mean / mean.norm().clamp(min=1e-12)
    strongest = int(up.abs().argmax())
    sign = "+" if up[strongest] > 0 else "-"
    return Gravity(
        up=(up[0].item(), up[1].item(), up[2].item()),
        agreement=mean.norm().item(),
        axis=f"{sign}{'xyz'[strongest]}",
        off_axis=_degrees(up[strongest].abs()),
        tilt=_degrees((ups @ up).median()),
    )


def path_length(poses: Tensor) -> float:
    """Length of the way from camera centre to camera centre in the order given, world units."""
    return (centers(poses)[1:] - centers(poses)[:-1]).norm(dim=1).sum().item()


def median_depth(poses: Tensor, points: Tensor) -> float:
    """Median distance from a camera to a point, world units."""
    some = points[:: max(1, len(points) // 20_000)].double()
    return torch.cdist(centers(poses), some).median().item()


def centers(poses: Tensor) -> Tensor:
    """Camera centres [F, 3] of cam_from_world [F, 4, 4]."""
    return -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0]


def _degrees(cosine: Tensor) -> float:
    return torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).item()
