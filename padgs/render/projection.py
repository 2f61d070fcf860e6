"""Projection of Gaussians to footprints on the image (torch), and the low-pass filter that they get.

Each entry of `PROJECTIONS` is a function Request -> Footprints. A footprint gives every pixel a squared distance q;
order, alpha and blending are the same for all projections.

The low-pass filter widens a footprint, or the Gaussian, to about a pixel, so that none falls between pixels. Kinds:
pixels: a variance in the image plane, as in 3D Gaussian splatting; on a panorama a circle of the ERP image, which spans
less and less of the sphere towards the poles. angular: the same angle in every direction. solid: the same, but in 3D
and with the opacity lowered as the volume grows: the mass stays, and a thin Gaussian fades instead of swelling (3D
filter of SPaGS).

angular and solid add low_pass (r / f)^2 to the 3D covariance, at distance r and with f pixels per radian. Every
projection sees that as a circle of low_pass / f^2, because none sees along the direction of the mean.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.gaussians import Gaussians, rotation_matrices
from padgs.geometry.camera import Camera
from padgs.registry import lookup
from padgs.render.contract import FURTHEST, NEAREST, RenderOptions, Request

PROJECTIONS = {
    "erp": "padgs.render.planar:project_erp",
    "pinhole": "padgs.render.planar:project_pinhole",
    "tangent": "padgs.render.projective:project_tangent",
    "ray": "padgs.render.projective:project_ray",
}


@dataclass(frozen=True)
class Footprints(ABC):
    """N projected Gaussians of one view. Entries of invisible Gaussians may hold any value."""

    opacities: Tensor  # [N]
    depths: Tensor  # [N] radial distance of the mean, world units; ascending = front to back
    visible: Tensor  # [N] bool
    boxes: Tensor | None  # [N, 4] pixel indices drawn: first column, end column, first row, end row; None: all

    @abstractmethod
    def squared_distance(self, indices: Tensor, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Return q [P, K] of the Gaussians [K] at the pixels [P], and whether they act there, [P, K] bool."""

    def distance(self, indices: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Return where the Gaussians [K] lie on the rays of the pixels [P], [P, K] world units, without gradient."""
        return self.depths.detach()[indices].expand(len(rows), -1)

    def slope(self, indices: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Return |dq/dmean| [P, K] per world unit at constant covariance, without gradient; `ray` footprints only."""
        raise NotImplementedError(f"{type(self).__name__} do not implement slope; use projection=ray")


def project(request: Request) -> Footprints:
    """Return the footprints under the projection of the options."""
    footprints_of = lookup(PROJECTIONS, request.options.projection, "projection")
    gaussians, cam_from_world = request.gaussians, request.cam_from_world
    with torch.no_grad():
        first = footprints_of(request)
        visible = first.visible & (first.depths >= NEAREST) & (first.depths <= FURTHEST)
        rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
        ahead = rotation.T @ (rotation.new_tensor([0.0, 0.0, 1.0]) - translation)
    # Invisible Gaussians may hold any value (a mean on the camera, numbers that overflow), and 0 * inf is NaN in the
    # backward pass: a harmless Gaussian one unit ahead replaces them.
    chosen = visible[:, None]
    harmless = replace(
        gaussians,
        means=torch.where(chosen, gaussians.means, ahead),
        quats=torch.where(chosen, gaussians.quats, gaussians.quats.new_tensor([1.0, 0.0, 0.0, 0.0])),
        scales=torch.where(chosen, gaussians.scales, torch.ones_like(gaussians.scales)),
    )
    return replace(footprints_of(replace(request, gaussians=harmless)), visible=visible)


def plane_covariance(half_covariance: Tensor, low_pass: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return variances and covariance (uu, uv, vv) of A A^T + low_pass for A [N, 2, 3], and the determinant, all [N].

    The determinant is that of Lagrange's identity plus the low-pass terms; uu vv - uv^2 would cancel.
    """
    var_u, var_v = (half_covariance**2).sum(-1).unbind(-1)
    cov_uv = (half_covariance[:, 0] * half_covariance[:, 1]).sum(-1)
    minors = torch.linalg.cross(half_covariance[:, 0], half_covariance[:, 1])
    determinant = (minors**2).sum(-1) + low_pass * (var_u + var_v) + low_pass**2
    return var_u + low_pass, cov_uv, var_v + low_pass, determinant


def is_sound(determinant: Tensor) -> Tensor:
    """Return which covariances [N] can be inverted: positive and finite determinant."""
    return torch.isfinite(determinant.detach()) & (determinant.detach() > 0)


def camera_frame(request: Request) -> tuple[Tensor, Tensor]:
    """Return means [N, 3] and orientations R = R_cam R(q) [N, 3, 3] in the camera frame; Sigma = R diag(s)^2 R^T."""
    rotation, translation = request.cam_from_world[:3, :3], request.cam_from_world[:3, 3]
    return request.gaussians.means @ rotation.T + translation, rotation @ rotation_matrices(request.gaussians.quats)


@dataclass(frozen=True)
class LowPass:
    """The low-pass filter as kernels apply it."""

    in_plane: float  # variance added to the footprint: square pixels in a plane, square radians on a tangent plane
    widen: float  # square radians; times r^2 the variance added in 3D, before projecting
    compensate: bool  # lower the opacity as the Gaussian widens


def low_pass_of(options: RenderOptions, camera: Camera) -> LowPass:
    """Return how `options.low_pass` applies to this projection and camera."""
    kind, variance = options.resolved_low_pass_kind, options.low_pass
    if kind == "pixels":
        return LowPass(variance, 0.0, False)
    angle = variance / camera.focal**2
    if kind == "angular" and options.projection == "tangent":  # its covariance is already in square radians
        return LowPass(angle, 0.0, False)
    return LowPass(0.0, angle, kind == "solid")


def low_pass_filtered(gaussians: Gaussians, means: Tensor, low_pass: LowPass) -> Gaussians:
    """Return the Gaussians with scales and opacities after widening in 3D; `means` [N, 3] are in the camera frame.

    wide^2 = scale^2 + widen r^2; solid: opacity times sqrt(det Sigma / det Sigma') = prod(scale / wide).
    """
    if low_pass.widen == 0:
        return gaussians
    wide, share = widened_scales(gaussians.scales, low_pass.widen * (means * means).sum(-1))
    opacities = gaussians.opacities * share if low_pass.compensate else gaussians.opacities
    return replace(gaussians, scales=wide, opacities=opacities)


def widened_scales(scales: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Return scales [N, 3] with a variance [N] added to each axis, and the old volume as a share [N] of the new one."""
    wide = torch.sqrt(scales**2 + variance[:, None])
    return wide, (scales / wide).prod(-1)
