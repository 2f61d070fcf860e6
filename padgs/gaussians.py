"""A set of 3D Gaussians: the interface between models and renderers."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians in the world frame with covariance R diag(scales)^2 R^T (Eq. 2).

    Quaternions are (w, x, y, z); the renderer normalises them. Scales are standard deviations
    (not logarithms) in world units. Colours are RGB in the color space of the images, not clamped.
    """

    means: Tensor  # [N, 3] world
    quats: Tensor  # [N, 4] wxyz
    scales: Tensor  # [N, 3] > 0
    opacities: Tensor  # [N] in [0, 1]
    colors: Tensor  # [N, 3]

    def __len__(self) -> int:
        return self.means.shape[0]

    def chosen(self, rows: Tensor | slice) -> Gaussians:
        """Return the Gaussians of some rows, given by index, mask or slice; of a slice without a copy."""
        return replace(self, **{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def to(self, *args, **kwargs) -> Gaussians:
        """Return the Gaussians on another device or in another dtype (arguments of `Tensor.to`)."""
        return replace(self, **{f.name: getattr(self, f.name).to(*args, **kwargs) for f in fields(self)})


def rotation_matrices(quats: Tensor) -> Tensor:
    """Return rotation matrices [..., 3, 3] of quaternions (w, x, y, z) [..., 4], normalised first.

    >>> rotation_matrices(torch.tensor([2.0, 0.0, 0.0, 0.0]))
    tensor([[1., 0., 0.],
            [0., 1., 0.],
            [0., 0., 1.]])
    """
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = (
        torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), dim=-1),
        torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), dim=-1),
        torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), dim=-1),
    )
    return torch.stack(rows, dim=-2)
