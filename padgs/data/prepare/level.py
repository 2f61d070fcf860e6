"""A world whose +z is up: turned so that the cameras' common up becomes that."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from padgs.data.capture import Cloud, Frame
from padgs.data.trajectory import gravity

LEVEL_AGREEMENT = 0.9  # length of the mean of the cameras' up directions from which they have a common one


def levelled(frames: tuple[Frame, ...], cloud: Cloud) -> tuple[tuple[Frame, ...], Cloud, str]:
    """The same in a world whose +z is the cameras' common up, if they have one, and a note."""
    found = gravity(torch.stack([frame.cam_from_world for frame in frames]))
    if found.agreement < LEVEL_AGREEMENT:
        return frames, cloud, "the cameras have no common up; the world stays as structure from motion left it"
    new_from_old = rotation_between(torch.tensor(found.up, dtype=torch.float64))
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = new_from_old.mT
    frames = tuple(replace(frame, cam_from_world=frame.cam_from_world @ turn) for frame in frames)
    cloud = Cloud(cloud.points @ new_from_old.mT, cloud.colors)
    return frames, cloud, "the world's +z is the common up of the cameras; its scale is arbitrary"


def rotation_between(up: Tensor) -> Tensor:
    """The smallest rotation [3, 3] that takes a unit vector [3] to +z.

    >>> rotation_between(torch.tensor([0.0, -1.0, 0.0]))
    tensor([[ 1.,  0.,  0.],
            [ 0.,  0.,  1.],
            [ 0., -1.,  0.]])
    """
    x, y, z = up.tolist()
    if z < -1 + 1e-9:
        return torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=up.dtype))
    k = 1 / (1 + z)
    rows = ((1 - k * x * x, -k * x * y, -x), (-k * x * y, 1 - k * y * y, -y), (x, y, z))
    return torch.tensor(rows, dtype=up.dtype) + 0.0
