"""The distortion degree of anchors, and opacity modulation by it (paper Eq. 15)."""

from __future__ import annotations

from torch import Tensor

OMEGA_AXES = ("camera_y", "world_z")


def polar_axis(name: str, cam_from_world: Tensor) -> Tensor:
    """The axis [3], in the world frame, about which latitude is measured.

    Args:
        name: camera_y, the panorama's own polar axis, as the paper defines it; world_z, as the released code does,
            which agrees only where the world's z axis is vertical and the camera is level.
        cam_from_world: [4, 4].
    """
    if name == "camera_y":
        return cam_from_world[1, :3]
    if name == "world_z":
        axis = cam_from_world.new_zeros(3)
        axis[2].fill_(1)  # nothing is sent to a GPU
        return axis
    raise ValueError(f"unknown omega_axis {name!r}; known: {', '.join(OMEGA_AXES)}")


def direction_distortion(directions: Tensor, axis: Tensor) -> Tensor:
    """Distortion degree sin^2(latitude) [...] of unit directions [..., 3] about a unit axis [3] (Eq. 12).

    >>> import torch
    >>> direction_distortion(torch.tensor([[0.0, -1.0, 0.0], [0.6, 0.8, 0.0]]), torch.tensor([0.0, 1.0, 0.0]))
    tensor([1.0000, 0.6400])
    """
    sine = directions @ axis
    return sine * sine


def modulate(opacities: Tensor, distortion: Tensor, tau: float, max_distortion: float = 1.0) -> Tensor:
    """Opacities [N] times 1 - tau Omega (Eq. 15); tau 0 leaves them as they are.

    Args:
        opacities: [N].
        distortion: Omega [N] in [0, 1] of each Gaussian's anchor.
        tau: strength in [0, 1].
        max_distortion: Omega is limited to it; the released code uses 1 - 1e-4.

    >>> import torch
    >>> modulate(torch.tensor([0.5, 0.5]), torch.tensor([0.0, 1.0]), 0.9)
    tensor([0.5000, 0.0500])
    """
    if tau == 0:
        return opacities
    return opacities * (1 - tau * distortion.clamp(max=max_distortion))
