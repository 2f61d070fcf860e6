"""Projection of Gaussians to footprints on the image (torch), the low-pass filter that they get, planar footprints.

Each entry of `PROJECTIONS` is a function Request -> Footprints. A footprint gives every pixel a squared distance q;
order, alpha and blending are the same for all projections.

The low-pass filter widens a footprint, or the Gaussian, to about a pixel, so that none falls between pixels. Kinds:
pixels: a variance in the image plane, as in 3D Gaussian splatting; on a panorama a circle of the ERP image, which spans
less and less of the sphere towards the poles. angular: the same angle in every direction. solid: the same, but in 3D
and with the opacity lowered as the volume grows: the mass stays, and a thin Gaussian fades instead of swelling (3D
filter of SPaGS).

angular and solid add low_pass (r / f)^2 to the 3D covariance, at distance r and with f pixels per radian. Every
projection sees that as a circle of low_pass / f^2, because none sees along the direction of the mean.

Planar footprints are 2D Gaussians in pixels, by the Jacobian of the camera at the mean (Eq. 3, 5): erp is the
projection of OmniGS, ODGS and PaD-GS; pinhole that of 3D Gaussian splatting.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.checks import lookup
from padgs.gaussians import Gaussians, rotation_matrices
from padgs.geometry.camera import Camera, Panorama, Pinhole
from padgs.geometry.panorama import longitude_latitude, pixel_from_angles, projection_jacobian
from padgs.render.contract import ALPHA_MIN, FURTHEST, NEAREST, RenderOptions, Request

PROJECTIONS = {
    "erp": "padgs.render.projection:project_erp",
    "pinhole": "padgs.render.projection:project_pinhole",
    "tangent": "padgs.render.projective:project_tangent",
    "ray": "padgs.render.projective:project_ray",
}
MIN_COS_LATITUDE = 1e-4  # within 0.006 degrees of the axis an erp footprint is undefined: its width is 1 / cos
TILE = 16  # pixels, of the published rasterizers
SLOPE_LIMIT = 1.3  # pinhole: limit of slopes in the Jacobian, as a multiple of the half field of view


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


@dataclass(frozen=True)
class PlanarFootprints(Footprints):
    """Projected Gaussians in pixels."""

    boxes: Tensor  # [N, 4]; columns not reduced mod W
    centers: Tensor  # [N, 2] (u, v)
    whitening: Tensor  # [N, 3] (a, b, c) of the Cholesky factor K = [[a, b], [0, c]] of the inverse S^-1 = K^T K
    turn: float  # period of the columns in pixels (the width, with wrap), or infinity

    def squared_distance(self, indices: Tensor, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Return q = |K delta|^2, with delta from the nearest copy of the centre across the seam.

        Expanded to A du^2 + 2 B du dv + C dv^2 it would cancel far from the centre of a long oblique footprint.
        """
        centers, boxes = self.centers[indices], self.boxes[indices]
        dv = rows[:, None] + 0.5 - centers[:, 1]
        du = columns[:, None] + 0.5 - centers[:, 0]
        columns = columns[:, None].to(centers)
        if self.turn < torch.inf:  # into [-W/2, W/2)
            turns = torch.floor(du.detach() / self.turn + 0.5)
            du, columns = du - turns * self.turn, columns - turns * self.turn
        a, b, c = self.whitening[indices].unbind(-1)
        q = (a * du + b * dv) ** 2 + (c * dv) ** 2
        rows = rows[:, None]
        inside = (columns >= boxes[:, 0]) & (columns < boxes[:, 1]) & (rows >= boxes[:, 2]) & (rows < boxes[:, 3])
        return q, inside


def project_erp(request: Request) -> PlanarFootprints:
    """Project to the ERP image: means by Eq. 6-7, covariances by their Jacobian (Eq. 3, 5)."""
    camera, options = request.camera, request.options
    means, orientations = camera_frame(request)
    request = replace(request, gaussians=low_pass_filtered(request.gaussians, means, low_pass_of(options, camera)))
    squared_radius = (means * means).sum(-1).detach()
    in_front = squared_radius > options.near**2
    # Next to the axis the derivative diverges; such a footprint is constant to autograd.
    near_axis = (means[:, 0] ** 2 + means[:, 2] ** 2).detach() < MIN_COS_LATITUDE**2 * squared_radius
    means = torch.where(near_axis[:, None], means.detach(), means)
    centers = pixel_from_angles(*longitude_latitude(means), camera.width, camera.height)
    jacobian = projection_jacobian(means, camera.width, camera.height, min_cos_latitude=MIN_COS_LATITUDE)
    return _footprints(request, means, orientations, centers, jacobian, in_front)


def project_pinhole(request: Request) -> PlanarFootprints:
    """Project as 3D Gaussian splatting does: u = fx x / z + cx, Jacobian with limited slopes."""
    camera, options = request.camera, request.options
    assert isinstance(camera, Pinhole), type(camera)  # guaranteed by `check_inputs`
    means, orientations = camera_frame(request)
    request = replace(request, gaussians=low_pass_filtered(request.gaussians, means, low_pass_of(options, camera)))
    in_front = means[:, 2].detach() > options.near
    x, y, z = means.unbind(-1)
    centers = torch.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), dim=-1)
    limit_x = SLOPE_LIMIT * 0.5 * camera.width / camera.fx
    limit_y = SLOPE_LIMIT * 0.5 * camera.height / camera.fy
    zero = torch.zeros_like(z)
    row_u = torch.stack((camera.fx / z, zero, -camera.fx / z * (x / z).clamp(-limit_x, limit_x)), dim=-1)
    row_v = torch.stack((zero, camera.fy / z, -camera.fy / z * (y / z).clamp(-limit_y, limit_y)), dim=-1)
    jacobian = torch.stack((row_u, row_v), dim=-2)
    return _footprints(request, means, orientations, centers, jacobian, in_front)


def _footprints(
    request: Request, means: Tensor, orientations: Tensor, centers: Tensor, jacobian: Tensor, in_front: Tensor
) -> PlanarFootprints:
    gaussians, camera, options = request.gaussians, request.camera, request.options
    if request.mean_offsets is not None:
        centers = centers + request.mean_offsets * centers.new_tensor([camera.width / 2, camera.height / 2])
    half_covariance = jacobian @ (orientations * gaussians.scales[:, None, :])  # [N, 2, 3]
    var_u, cov_uv, var_v, determinant = plane_covariance(half_covariance, low_pass_of(options, camera).in_plane)
    a = torch.sqrt(var_v / determinant)
    whitening = torch.stack((a, -a * (cov_uv / var_v), torch.rsqrt(var_v)), dim=-1)
    covariance = torch.stack((var_u, cov_uv, var_v), dim=-1).detach()
    opacities = gaussians.opacities.detach()
    if options.bounds == "square":
        boxes = square_boxes(centers.detach(), 0.5 * (covariance[:, 0] + covariance[:, 2]), determinant.detach())
    else:
        boxes = _exact_boxes(centers.detach(), covariance, opacities)
    turn = float(camera.width) if options.wrap and isinstance(camera, Panorama) else torch.inf
    on_image = is_on_image(boxes, camera.width, camera.height, wraps=turn < torch.inf)
    visible = in_front & (opacities >= ALPHA_MIN) & on_image & is_sound(determinant)
    return PlanarFootprints(gaussians.opacities, means.norm(dim=-1), visible, boxes, centers, whitening, turn)


def _exact_boxes(centers: Tensor, covariance: Tensor, opacities: Tensor) -> Tensor:
    """Return the pixels [N, 4] that can have alpha >= 1/255: the box of the ellipse q <= k = 2 ln(255 opacity)."""
    k = 2 * torch.log((opacities / ALPHA_MIN).clamp(min=1))
    slack = 1 + 1e-4  # rounding must never cost a contribution
    half = torch.sqrt(k[:, None] * covariance[:, [0, 2]]) * slack + 1e-3
    first = torch.ceil(centers - half - 0.5)
    end = torch.floor(centers + half - 0.5) + 1
    return torch.stack((first[:, 0], end[:, 0], first[:, 1], end[:, 1]), dim=-1)


def square_boxes(centers: Tensor, middle: Tensor, determinant: Tensor) -> Tensor:
    """Return the pixels [N, 4] of `bounds=square`, as published: 3 sigma of the longest axis, in whole tiles.

    Centers [N, 2] are pixels, `middle` and `determinant` [N] half the trace and the determinant of the covariance.
    """
    longest = middle + torch.sqrt((middle * middle - determinant).clamp(min=0.1))
    radius = torch.ceil(3 * torch.sqrt(longest))[:, None]
    first = TILE * torch.floor((centers - 0.5 - radius) / TILE)
    end = TILE * torch.floor((centers - 0.5 + radius + TILE - 1) / TILE)
    return torch.stack((first[:, 0], end[:, 0], first[:, 1], end[:, 1]), dim=-1)


def is_on_image(boxes: Tensor, width: int, height: int, *, wraps: bool = False) -> Tensor:
    """Return which boxes [N, 4] contain a pixel of the image, [N] bool; `wraps`: columns repeat across the seam."""
    rows = (boxes[:, 3] > 0) & (boxes[:, 2] < height) & (boxes[:, 3] > boxes[:, 2]) & (boxes[:, 1] > boxes[:, 0])
    return rows if wraps else rows & (boxes[:, 1] > 0) & (boxes[:, 0] < width)
