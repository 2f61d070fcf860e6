"""Alignment of two sets of poses of the same cameras by a similarity.

The rotation comes from the orientations, because centres on a nearly straight path do not determine the rotation about
it. Scale and translation are least squares on the centres.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.data.camera_paths import centers


@dataclass(frozen=True)
class Similarity:
    """first_from_second: x_first = scale * rotation @ x_second + translation."""

    scale: float
    rotation: Tensor  # [3, 3]
    translation: Tensor  # [3]

    def __call__(self, points: Tensor) -> Tensor:
        """Map points [..., 3] of the second world to the first."""
        return self.scale * points @ self.rotation.mT + self.translation

    def inverse(self) -> Similarity:
        """Return second_from_first."""
        return Similarity(1 / self.scale, self.rotation.mT, -self.translation @ self.rotation / self.scale)


@dataclass(frozen=True)
class Difference:
    """Residuals of the alignment per camera."""

    distance: Tensor  # [F] between centres, units of the first world
    degrees: Tensor  # [F] between orientations


def align(first: Tensor, second: Tensor) -> tuple[Similarity, Difference]:
    """Return the similarity first_from_second and its residuals.

    Args:
        first: cam_from_world [F, 4, 4] float64.
        second: cam_from_world [F, 4, 4] float64, the same cameras in the same order.

    Raises:
        ValueError: fewer than two cameras, or centres that all coincide: there is no scale then.

    >>> pose = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    >>> pose[1, 0, 3] = -1  # the second camera stands at x = 1
    >>> twice = pose.clone()
    >>> twice[:, :3, 3] *= 2
    >>> align(pose, twice)[0].scale
    0.5
    """
    if first.shape != second.shape or len(first) < 2:
        raise ValueError(f"cannot align {len(first)} poses with {len(second)}; both must be the same two or more")
    rotations = first[:, :3, :3].mT @ second[:, :3, :3]  # first_from_second as each camera sees it
    u, _, vh = torch.linalg.svd(rotations.sum(0))
    flip = torch.ones_like(u[0])
    flip[2] = torch.linalg.det(u @ vh)
    rotation = u * flip @ vh
    a, b = centers(first), centers(second)
    spread = (b - b.mean(0)) @ rotation.mT
    variance = spread.square().sum().item()
    if not variance > (torch.finfo(b.dtype).eps * b.abs().max().item()) ** 2:
        raise ValueError("cannot align poses whose centres all coincide: there is no scale")
    scale = ((a - a.mean(0)) * spread).sum().item() / variance
    if not scale > 0:
        raise ValueError(f"cannot align poses whose centres have no shape in common: the best scale is {scale:.3g}")
    similarity = Similarity(scale, rotation, a.mean(0) - scale * rotation @ b.mean(0))
    chord = (rotations - rotation).flatten(1).norm(dim=1) / (2 * 2**0.5)  # exact for small angles too
    degrees = torch.rad2deg(2 * torch.asin(chord.clamp(max=1)))
    return similarity, Difference((similarity(b) - a).norm(dim=1), degrees)
