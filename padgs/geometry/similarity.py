"""Similarities between worlds: a scale, a rotation and a translation."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass(frozen=True)
class Similarity:
    """first_from_second: x_first = scale * rotation @ x_second + translation."""

    scale: float = 1.0
    rotation: Tensor = field(default_factory=lambda: torch.eye(3, dtype=torch.float64))  # [3, 3]
    translation: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))  # [3]

    @classmethod
    def turning(cls, direction: Tensor, to: tuple[float, float, float]) -> Similarity:
        """Return the smallest rotation that maps a direction [3] to another."""
        from scipy.spatial.transform import Rotation

        return cls(rotation=torch.from_numpy(Rotation.align_vectors([to], [direction.tolist()])[0].as_matrix()))

    def __call__(self, points: Tensor) -> Tensor:
        """Map points [..., 3] of the second world to the first."""
        return self.scale * points @ self.rotation.mT + self.translation

    def __matmul__(self, inner: Similarity) -> Similarity:
        """Return the similarity that applies `inner`, then this one."""
        return Similarity(self.scale * inner.scale, self.rotation @ inner.rotation, self(inner.translation))

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
