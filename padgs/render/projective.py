"""Projective footprints (torch): they take the ray of a pixel, so they work with any camera and have no pole or seam.

tangent: the Gaussian flattened onto the tangent plane of the sphere at its mean (OP43DGS).
ray: the largest value of the 3D Gaussian along the ray (SPaGS).
"""

from dataclasses import dataclass
from math import pi

import torch
from torch import Tensor

from padgs.geometry.camera import Panorama
from padgs.geometry.panorama import longitude_latitude, pixel_from_angles, projection_jacobian
from padgs.render import projection
from padgs.render.contract import ALPHA_MIN, Request, kernel, largest_q
from padgs.render.projection import Footprints

PUBLISHED_FOCAL = 512  # pixels per radian on the tangent planes of the released OP43DGS, for every image size
LEAST_COS_LATITUDE, LEAST_DIVISOR = 1e-4, 1e-20  # keep the directions of the poles finite


@dataclass(frozen=True)
class TangentFootprints(Footprints):
    """Gaussians projected to their tangent planes."""

    normals: Tensor  # [N, 3] direction of the mean
    whitening: Tensor  # [N, 2, 3] L: q = |L d|^2 / (n.d)^2
    rays: Tensor  # [H, W, 3]
    steepness: float

    def squared_distance(self, indices: Tensor, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Return f(q), q = tau^T S^-1 tau with tau = E d / (n.d), on the side of the camera where the mean is."""
        d = self.rays[rows, columns]  # [P, 3]
        ahead = d @ self.normals[indices].T  # [P, K]
        inside = ahead.detach() > 0
        ahead = torch.where(inside, ahead, torch.ones_like(ahead))
        offsets = torch.einsum("pc,kic->pki", d, self.whitening[indices]) / ahead[..., None]
        if self.boxes is not None:
            first_column, end_column, first_row, end_row = self.boxes[indices].unbind(-1)
            u, v = columns[:, None], rows[:, None]
            inside = inside & (u >= first_column) & (u < end_column) & (v >= first_row) & (v < end_row)
        return kernel((offsets * offsets).sum(-1), self.steepness), inside


@dataclass(frozen=True)
class RayFootprints(Footprints):
    """Gaussians in the camera frame, evaluated along rays."""

    means: Tensor  # [N, 3] camera frame
    whitening: Tensor  # [N, 3, 3] M^-1 with Sigma = M M^T
    rays: Tensor  # [H, W, 3]
    near: float
    steepness: float

    def squared_distance(self, indices: Tensor, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
        """Return f(q), q = |o - t w|^2, o = M^-1 mean, w = M^-1 d, and t = o.w / w.w, the distance of the maximum."""
        o, w, t = self._maximum(indices, rows, columns)
        offset = o - t[..., None] * w
        return kernel((offset * offset).sum(-1), self.steepness), t.detach() > self.near

    def distance(self, indices: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Return t, the distance of the maximum along the ray."""
        with torch.no_grad():
            return self._maximum(indices, rows, columns)[2]

    def slope(self, indices: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Return 2 f'(q) |M^-T (o - t w)|; the derivative through t vanishes at the maximum."""
        with torch.no_grad():
            o, w, t = self._maximum(indices, rows, columns)
            q = (o - t[..., None] * w).square().sum(-1)
            slope = torch.einsum("kic,pki->pkc", self.whitening[indices], o - t[..., None] * w).norm(dim=-1)
            return 2 * (1 - self.steepness + 2 * self.steepness * q) * slope

    def _maximum(self, indices: Tensor, rows: Tensor, columns: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return o [K, 3], w [P, K, 3] and t [P, K]."""
        whitening = self.whitening[indices]
        o = torch.einsum("kic,kc->ki", whitening, self.means[indices])
        w = torch.einsum("kic,pc->pki", whitening, self.rays[rows, columns])
        return o, w, (o * w).sum(-1) / (w * w).sum(-1)


def project_tangent(request: Request) -> TangentFootprints:
    """Project to the tangent plane spanned by E: S = E Sigma E^T / r^2 (+ the angular low-pass)."""
    camera, options = request.camera, request.options
    means, orientations = projection.camera_frame(request)
    in_front = (means * means).sum(-1).detach() > options.near**2
    if request.mean_offsets is not None:
        means = means + mean_shift(means, request.mean_offsets)
    low_pass = projection.low_pass_of(options, camera)
    gaussians, low_pass = projection.low_pass_filtered(request.gaussians, means, low_pass), low_pass.in_plane
    radius = means.norm(dim=-1)
    normal = means / radius[:, None]
    tangent = _tangent_basis(normal)  # [N, 2, 3]
    spread = orientations * gaussians.scales[:, None, :]
    half = tangent @ spread / radius[:, None, None]  # [N, 2, 3]
    var_0, covariance, _, determinant = projection.plane_covariance(half, low_pass)
    # L = C^-1 E with the Cholesky factor C of S: its first row is E_0 / c, its second orthogonal to it under S.
    first = tangent[:, 0] / torch.sqrt(var_0)[:, None]
    second = (tangent[:, 1] - (covariance / var_0)[:, None] * tangent[:, 0]) / torch.sqrt(determinant / var_0)[:, None]
    whitening = torch.stack((first, second), dim=-2)
    visible = in_front & (gaussians.opacities.detach() >= ALPHA_MIN) & projection.is_sound(determinant)
    boxes, rays = None, camera.rays(dtype=means.dtype, device=means.device)
    if options.bounds == "square" and isinstance(camera, Panorama):
        boxes = tangent_boxes(means.detach(), spread.detach(), determinant.detach(), low_pass, camera)
        visible &= projection.is_on_image(boxes, camera.width, camera.height)
    return TangentFootprints(gaussians.opacities, radius, visible, boxes, normal, whitening, rays, options.steepness)


def project_ray(request: Request) -> RayFootprints:
    """Project to rays: M^-1 = diag(1 / scale) R^T. Cull Gaussians that contain the camera: |M^-1 mean|^2 <= k.

    k = `largest_q` bounds the drawn ellipsoid. With near_cull=ellipsoid, also cull where that ellipsoid reaches
    the plane n.x = near, n the direction of the mean: r - sqrt(k n^T Sigma n) <= near (SPaGS).
    """
    camera, options = request.camera, request.options
    means, orientations = projection.camera_frame(request)
    in_front = (means * means).sum(-1).detach() > options.near**2
    if request.mean_offsets is not None:
        means = means + mean_shift(means, request.mean_offsets)
    gaussians = projection.low_pass_filtered(request.gaussians, means, projection.low_pass_of(options, camera))
    radius, opacities = means.norm(dim=-1), gaussians.opacities
    whitening = orientations.transpose(-1, -2) / gaussians.scales[:, :, None]
    distance = (torch.einsum("kic,kc->ki", whitening, means) ** 2).sum(-1).detach()
    drawn = (opacities.detach() >= ALPHA_MIN) & torch.isfinite(gaussians.scales.detach()).all(-1)
    largest = largest_q(opacities.detach(), options.steepness)
    outside = distance > largest
    if options.near_cull == "ellipsoid":
        along = ((orientations * gaussians.scales[:, None, :]).mT @ (means / radius[:, None])[..., None]).detach()
        outside &= radius.detach() - torch.sqrt(largest * (along[..., 0] ** 2).sum(-1)) > options.near
    visible = in_front & drawn & outside & torch.isfinite(distance)  # else float overflows or nothing spreads
    rays = camera.rays(dtype=means.dtype, device=means.device)
    return RayFootprints(opacities, radius, visible, None, means, whitening, rays, options.near, options.steepness)


def mean_shift(means: Tensor, mean_offsets: Tensor) -> Tensor:
    """Return the shift [N, 3] of camera-frame means along their sphere for offsets on a panorama of 2 x 2 units."""
    x, y, z = means.detach().unbind(-1)
    rho = torch.sqrt(x * x + z * z)
    east = torch.stack((z, torch.zeros_like(x), -x), dim=-1)  # of length rho = r cos(latitude)
    down = torch.stack((-x * y, rho * rho, -y * z), dim=-1) / rho.clamp(min=1e-30)[:, None]  # of length r
    return mean_offsets[:, :1] * pi * east + mean_offsets[:, 1:] * (pi / 2) * down


def _tangent_basis(normals: Tensor) -> Tensor:
    """Return two arbitrary orthonormal rows [N, 2, 3] orthogonal to each normal."""
    axis = torch.nn.functional.one_hot(normals.abs().argmin(-1), 3).to(normals)
    first = torch.nn.functional.normalize(torch.linalg.cross(normals, axis), dim=-1)
    return torch.stack((first, torch.linalg.cross(normals, first)), dim=-2)


def tangent_boxes(means: Tensor, spread: Tensor, determinant: Tensor, low_pass: float, camera: Panorama) -> Tensor:
    """Return the pixels [N, 4] that the released OP43DGS renders; they grow with the distance of a mean, in any units.

    It computes the radius from the trace of the footprint in the panorama, by a Jacobian whose lower row is divided by
    sqrt(x^2 + z^2 r^2) instead of r^2 sqrt(x^2 + z^2), and the determinant of the footprint on a tangent plane of 512
    pixels per radian. Means [N, 3] are in the camera frame, the covariance is A A^T for `spread` [N, 3, 3] A, and
    `determinant` [N] and `low_pass` are those on the tangent plane in (square) square radians.
    """
    x, y, z = means.unbind(-1)
    right = (x * x + y * y + z * z) * torch.sqrt(x * x + z * z)
    written = torch.sqrt(x * x + z * z * (x * x + y * y + z * z)).clamp(min=LEAST_DIVISOR)
    jacobian = projection_jacobian(means, camera.width, camera.height, min_cos_latitude=LEAST_COS_LATITUDE)
    var_u, var_v = ((jacobian @ spread) ** 2).sum(-1).unbind(-1)
    trace = var_u + (right / written) ** 2 * var_v + 2 * low_pass * PUBLISHED_FOCAL**2
    centers = pixel_from_angles(*longitude_latitude(means), camera.width, camera.height)
    return projection.square_boxes(centers, 0.5 * trace, determinant * PUBLISHED_FOCAL**4)
