"""How one Gaussian becomes a footprint on the image (torch): the entries of `PROJECTIONS`.

Each entry is a function (gaussians, cam_from_world, camera, options, probe) -> Footprints. A footprint gives every pixel
a squared distance q; everything after that (order, alpha, blending) is the same for all.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from padgs.camera import Camera
from padgs.gaussians import Gaussians, rotation_matrices
from padgs.registry import lookup
from padgs.render.contract import RenderOptions

PROJECTIONS = {
    "erp": "padgs.render.planar:project_erp",
    "pinhole": "padgs.render.planar:project_pinhole",
    "tangent": "padgs.render.projective:project_tangent",
    "ray": "padgs.render.projective:project_ray",
}


class Footprints(Protocol):
    """N projected Gaussians of one view. Entries of Gaussians that are not visible are finite but mean nothing."""

    opacities: Tensor  # [N]
    depths: Tensor  # [N] radial distance of the mean, world units; ascending = front to back
    visible: Tensor  # [N] bool

    def squared_distance(self, indices: Tensor, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Squared distance q [P, K] of the Gaussians [K] at the pixels [P], and whether they act there, [P, K] bool."""
        ...


def project(
    gaussians: Gaussians,
    cam_from_world: Tensor,
    camera: Camera,
    options: RenderOptions,
    probe: Tensor | None = None,
) -> Footprints:
    """Footprints under `options.projection`; arguments as in `torch_backend.rasterize`."""
    return lookup(PROJECTIONS, options.projection, "projection")(gaussians, cam_from_world, camera, options, probe)


def camera_frame(gaussians: Gaussians, cam_from_world: Tensor) -> tuple[Tensor, Tensor]:
    """Means [N, 3] and orientations R_cam R(q) [N, 3, 3] in the camera frame; Sigma = (R diag(s)) (R diag(s))^T."""
    rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
    return gaussians.means @ rotation.T + translation, rotation @ rotation_matrices(gaussians.quats)


def move_hidden(means: Tensor, in_front: Tensor) -> Tensor:
    """Means [N, 3] with those that are culled put in front of the camera: on the camera nothing is differentiable."""
    return torch.where(in_front[:, None], means, means.new_tensor([0.0, 0.0, 1.0]))
