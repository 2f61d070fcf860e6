"""Planar footprints (torch): a 2D Gaussian in pixels, by the Jacobian of the camera at the mean (Eq. 3, 5).

erp is the projection of OmniGS, ODGS and PaD-GS; pinhole that of 3D Gaussian splatting.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.geometry.camera import Panorama, Pinhole
from padgs.geometry.panorama import longitude_latitude, pixel_from_angles, projection_jacobian
from padgs.render.contract import ALPHA_MIN, Request
from padgs.render.projection import (
    Footprints,
    camera_frame,
    is_sound,
    low_pass_filtered,
    low_pass_of,
    plane_covariance,
)

MIN_COS_LATITUDE = 1e-4  # within 0.006 degrees of the axis an erp footprint is undefined: its width is 1 / cos
TILE = 16  # pixels, of the published rasterizers
SLOPE_LIMIT = 1.3  # pinhole: limit of slopes in the Jacobian, as a multiple of the half field of view


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
    """Return the pixels [N, 4] that can have alpha >= 1/255: `bounds=exact`, the default.

    opacity exp(-q / 2) >= 1/255 is the ellipse q <= k with k = 2 ln(255 opacity); its box has half widths sqrt(k var).
    """
    k = 2 * torch.log((opacities / ALPHA_MIN).clamp(min=1))
    slack = 1 + 1e-4  # rounding must never cost a contribution
    half = torch.sqrt(k[:, None] * covariance[:, [0, 2]]) * slack + 1e-3
    first = torch.ceil(centers - half - 0.5)
    end = torch.floor(centers + half - 0.5) + 1
    return torch.stack((first[:, 0], end[:, 0], first[:, 1], end[:, 1]), dim=-1)


def square_boxes(centers: Tensor, middle: Tensor, determinant: Tensor) -> Tensor:
    """Return the pixels [N, 4] of `bounds=square`, as published: 3 sigma of the longest axis, in whole tiles.

    Args:
        centers: [N, 2] (u, v) pixels.
        middle, determinant: [N] half the trace, and the determinant, of the covariance in square pixels.

    Returns:
        first column, end column, first row, end row of each Gaussian.
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
