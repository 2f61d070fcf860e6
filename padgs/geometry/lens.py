"""Dual-fisheye cameras: radial distortion of a half-sphere lens, and blending with the lens of the opposite axis.

Directions are unit vectors in the camera frame (x right, y down, z forward), angles are radians.
"""

import torch
from torch import Tensor

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}  # of the first lens, in the camera frame


def axis_direction(name: str) -> Tensor:
    """Return the axis [3] float64 of the first lens, by a name of `AXES`."""
    return torch.tensor(AXES[name], dtype=torch.float64)


def bend(directions: Tensor, axis: Tensor, coefficients: Tensor) -> Tensor:
    """Turn directions [..., 3] away from the axis [3] by the radial map; the identity if all coefficients k are 0.

    The angle theta from the axis becomes theta + e, e = theta (k1 theta^2 + k2 theta^4 + ...).
    d' = d cos(e) + t sin(e), t = (d cos(theta) - a) / sin(theta); on the axis e / sin = 0.
    """
    cosine = directions @ axis
    sine = torch.linalg.cross(directions, axis.expand_as(directions)).norm(dim=-1).clamp(min=1e-6)
    theta = torch.atan2(sine, cosine)
    square, total = theta * theta, torch.zeros_like(theta)
    for coefficient in reversed(coefficients.unbind()):  # Horner
        total = (total + coefficient) * square
    excess = theta * total
    away = (directions * cosine[..., None] - axis) / sine[..., None]
    return directions * torch.cos(excess)[..., None] + away * torch.sin(excess)[..., None]


def hemisphere_weight(directions: Tensor, axis: Tensor, blend: float) -> Tensor:
    """Return the weight in [0, 1] of the lens along the axis [3]: a smooth step over `blend` radians on both sides."""
    height = directions @ axis
    if blend == 0:
        return (height > 0).to(directions) + 0.5 * (height == 0).to(directions)
    x = (torch.asin(height.clamp(-1, 1)) / (2 * blend) + 0.5).clamp(0, 1)
    return x * x * (3 - 2 * x)
