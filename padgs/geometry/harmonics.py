"""Real spherical harmonics up to degree 3, with the order and signs that 3D Gaussian files use.

Functions of degree l are ordered m = -l .. l; odd m have a minus sign (Condon-Shortley). They are orthonormal on the
unit sphere.
"""

import math

import torch
from torch import Tensor

MAX_DEGREE = 3
DC = math.sqrt(1 / (4 * math.pi))  # the constant function of degree 0


def basis(directions: Tensor, degree: int) -> Tensor:
    """Return the values [..., (degree + 1)^2] of all functions up to `degree` at unit directions [..., 3].

    >>> [round(value, 4) for value in basis(torch.tensor([0.0, 0.0, 1.0]), 1).tolist()]
    [0.2821, -0.0, 0.4886, -0.0]
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree is {degree}; spherical harmonics must have degree 0 to {MAX_DEGREE}")
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    values = [torch.full_like(x, DC)]
    if degree >= 1:
        c = math.sqrt(3 / (4 * math.pi))
        values += [-c * y, c * z, -c * x]
    if degree >= 2:
        c = math.sqrt(15 / (4 * math.pi))
        middle = math.sqrt(5 / (16 * math.pi))
        values += [c * x * y, -c * y * z, middle * (2 * zz - xx - yy), -c * x * z, 0.5 * c * (xx - yy)]
    if degree >= 3:
        outer, inner = math.sqrt(35 / (32 * math.pi)), math.sqrt(21 / (32 * math.pi))
        middle = math.sqrt(105 / (4 * math.pi))
        values += [
            -outer * y * (3 * xx - yy),
            middle * x * y * z,
            -inner * y * (4 * zz - xx - yy),
            math.sqrt(7 / (16 * math.pi)) * z * (2 * zz - 3 * xx - 3 * yy),
            -inner * x * (4 * zz - xx - yy),
            0.5 * middle * z * (xx - yy),
            -outer * x * (xx - 3 * yy),
        ]
    return torch.stack(values, dim=-1)


def dc_from_colors(colors: Tensor) -> Tensor:
    """Return the coefficient of degree 0 for RGB colours in [0, 1]; a zero coefficient is middle grey."""
    return (colors - 0.5) / DC
