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

    def pose(self, cam_from_world: Tensor) -> Tensor:
        """Map a pose [4, 4] of the second world to the first; float64."""
        cam_from_world = cam_from_world.to(self.rotation)
        pose = torch.eye(4, dtype=torch.float64, device=self.rotation.device)
        pose[:3, :3] = cam_from_world[:3, :3] @ self.rotation.mT
        pose[:3, 3] = self.scale * cam_from_world[:3, 3] - pose[:3, :3] @ self.translation
        return pose

    def inverse(self) -> Similarity:
        """Return second_from_first."""
        return Similarity(1 / self.scale, self.rotation.mT, -self.translation @ self.rotation / self.scale)


@dataclass(frozen=True)
class Difference:
    """Residuals of the alignment per camera."""

    distance: Tensor  # [F] between centres, units of the first world
    degrees: Tensor  # [F] between orientations


def align(first: Tensor, second: Tensor) -> tuple[Similarity, Difference]:
    """Return the similarity first_from_second and its residuals for poses cam_from_world [F, 4, 4] float64."""
    rotations = first[:, :3, :3].mT @ second[:, :3, :3]  # first_from_second as each camera sees it
    u, _, vh = torch.linalg.svd(rotations.sum(0))
    flip = torch.ones_like(u[0])
    flip[2] = torch.linalg.det(u @ vh)
    rotation = u * flip @ vh
    a, b = centers(first), centers(second)
    spread = (b - b.mean(0)) @ rotation.mT
    scale = (((a - a.mean(0)) * spread).sum() / spread.square().sum()).item()
    similarity = Similarity(scale, rotation, a.mean(0) - scale * rotation @ b.mean(0))
    chord = (rotations - rotation).flatten(1).norm(dim=1) / (2 * 2**0.5)  # exact for small angles too
    degrees = torch.rad2deg(2 * torch.asin(chord.clamp(max=1)))
    return similarity, Difference((similarity(b) - a).norm(dim=1), degrees)
