"""How one Gaussian becomes a footprint on the image (torch): the entries of `PROJECTIONS`.

Each entry is a function Request -> Footprints. A footprint gives every pixel a squared distance q; everything after
that (order, alpha, blending) is the same for all.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.gaussians import rotation_matrices
from padgs.registry import lookup
from padgs.render.contract import FURTHEST, NEAREST, Request

PROJECTIONS = {
    "erp": "padgs.render.planar:project_erp",
    "pinhole": "padgs.render.planar:project_pinhole",
    "tangent": "padgs.render.projective:project_tangent",
    "ray": "padgs.render.projective:project_ray",
}


@dataclass(frozen=True)
class Footprints(ABC):
    """N projected Gaussians of one view. Entries of Gaussians that are not visible may hold anything."""

    opacities: Tensor  # [N]
    depths: Tensor  # [N] radial distance of the mean, world units; ascending = front to back
    visible: Tensor  # [N] bool
    boxes: Tensor | None  # [N, 4] pixel indices drawn: first column, end column, first row, end row; None: all

    @abstractmethod
    def squared_distance(self, indices: Tensor, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Squared distance q [P, K] of the Gaussians [K] at the pixels [P], and whether they act there, [P, K] bool."""

    def distance(self, indices: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Where the Gaussians [K] lie on the rays of the pixels [P]: [P, K] world units, no gradient; orders hybrid."""
        return self.depths.detach()[indices].expand(len(rows), -1)

    def slope(self, indices: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """|dq/dmean| [P, K] per world unit, covariances held, no gradient; of `ray` footprints only."""
        raise NotImplementedError(f"{type(self).__name__} do not say how q changes with their means")


def project(request: Request) -> Footprints:
    """Footprints under the projection of the options."""
    footprints_of = lookup(PROJECTIONS, request.options.projection, "projection")
    gaussians, cam_from_world = request.gaussians, request.cam_from_world
    with torch.no_grad():
        first = footprints_of(request)
        visible = first.visible & (first.depths >= NEAREST) & (first.depths <= FURTHEST)
        rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
        ahead = rotation.T @ (rotation.new_tensor([0.0, 0.0, 1.0]) - translation)
    # What is not drawn may hold anything (a mean on the camera, numbers that overflow), and in the backward pass
    # 0 * inf is NaN: a harmless Gaussian one unit ahead takes its place.
    chosen = visible[:, None]
    harmless = replace(
        gaussians,
        means=torch.where(chosen, gaussians.means, ahead),
        quats=torch.where(chosen, gaussians.quats, gaussians.quats.new_tensor([1.0, 0.0, 0.0, 0.0])),
        scales=torch.where(chosen, gaussians.scales, torch.ones_like(gaussians.scales)),
    )
    return replace(footprints_of(replace(request, gaussians=harmless)), visible=visible)


def plane_moments(half_covariance: Tensor, low_pass: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Variances and covariance (uu, uv, vv) of A A^T + low_pass for A [N, 2, 3], and the determinant, all [N].

    The determinant is that of Lagrange's identity plus the low-pass terms; uu vv - uv^2 would cancel.
    """
    var_u, var_v = (half_covariance**2).sum(-1).unbind(-1)
    cov_uv = (half_covariance[:, 0] * half_covariance[:, 1]).sum(-1)
    minors = torch.linalg.cross(half_covariance[:, 0], half_covariance[:, 1])
    determinant = (minors**2).sum(-1) + low_pass * (var_u + var_v) + low_pass**2
    return var_u + low_pass, cov_uv, var_v + low_pass, determinant


def is_sound(determinant: Tensor) -> Tensor:
    """Where [N] a covariance can be drawn with: elsewhere float overflows or nothing spreads."""
    return torch.isfinite(determinant.detach()) & (determinant.detach() > 0)


def camera_frame(request: Request) -> tuple[Tensor, Tensor]:
    """Means [N, 3] and orientations R_cam R(q) [N, 3, 3] in the camera frame; Sigma = (R diag(s)) (R diag(s))^T."""
    rotation, translation = request.cam_from_world[:3, :3], request.cam_from_world[:3, 3]
    return request.gaussians.means @ rotation.T + translation, rotation @ rotation_matrices(request.gaussians.quats)
