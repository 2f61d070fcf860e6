"""How one Gaussian becomes a footprint on the panorama (torch). Entries of `PROJECTIONS`.

erp: the chart model of OmniGS, ODGS and PaD-GS. The projected covariance is J Sigma J^T + low_pass I with the Jacobian
J of Eq. 6-7 at the mean (Eq. 3), and q = delta^T S^-1 delta in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.gaussians import Gaussians, rotation_matrices
from padgs.panorama import longitude_latitude, pixel_from_angles, projection_jacobian
from padgs.registry import lookup
from padgs.render.contract import ALPHA_MIN, RenderOptions

PROJECTIONS = {"erp": "padgs.render.projection:project_erp"}
MIN_COS_LATITUDE = 1e-4  # an erp footprint nearer to the axis than 0.006 degrees is undefined; see design.md section 3


@dataclass(frozen=True)
class Footprints:
    """Projected Gaussians of one view, in pixels. Rows of Gaussians that are not visible hold unused numbers."""

    centers: Tensor  # [N, 2] (u, v)
    conics: Tensor  # [N, 3] (A, B, C) of the inverse covariance [[A, B], [B, C]]
    opacities: Tensor  # [N]
    depths: Tensor  # [N] radial distance, world units
    sort_key: Tensor  # [N] ascending = front to back
    boxes: Tensor  # [N, 4] pixel indices drawn: first column, end column, first row, end row; columns not reduced mod W
    visible: Tensor  # [N] bool
    width: int
    height: int
    wrap: bool

    def touches_rows(self, indices: Tensor, first_row: int, last_row: int) -> Tensor:
        """Which of the Gaussians [K] may reach the pixel centres of rows first_row .. last_row - 1, [K] bool."""
        boxes = self.boxes[indices]
        return (boxes[:, 2] < last_row) & (boxes[:, 3] > first_row)

    def squared_distance(self, indices: Tensor, first_row: int, last_row: int) -> tuple[Tensor, Tensor]:
        """Squared distance q of each Gaussian [K] at each pixel centre of some rows, and whether it is in bounds.

        Returns:
            q [rows, W, K], inside [rows, W, K] bool.
        """
        centers, conics, boxes = self.centers[indices], self.conics[indices], self.boxes[indices]
        rows = torch.arange(first_row, last_row, dtype=centers.dtype, device=centers.device)
        columns = torch.arange(self.width, dtype=centers.dtype, device=centers.device)
        dv = rows[:, None, None] + 0.5 - centers[:, 1]
        du = columns[None, :, None] + 0.5 - centers[:, 0]
        if self.wrap:  # into [-W/2, W/2): the nearest copy across the seam
            turns = torch.floor((du.detach() + self.width / 2) / self.width)
            du = du - turns * self.width
            columns = columns[None, :, None] - turns * self.width
        else:
            columns = columns[None, :, None]
        a, b, c = conics.unbind(-1)
        q = a * du * du + 2 * b * du * dv + c * dv * dv
        rows = rows[:, None, None]
        inside = (columns >= boxes[:, 0]) & (columns < boxes[:, 1]) & (rows >= boxes[:, 2]) & (rows < boxes[:, 3])
        return q, inside


def project(
    gaussians: Gaussians,
    cam_from_world: Tensor,
    width: int,
    height: int,
    options: RenderOptions,
    probe: Tensor | None = None,
) -> Footprints:
    """Footprints under `options.projection`; arguments as in `padgs.render.render`."""
    footprints_of = lookup(PROJECTIONS, options.projection, "projection")
    with torch.no_grad():
        visible = footprints_of(gaussians, cam_from_world, width, height, options, probe).visible
        ahead = cam_from_world[:3, :3].T @ (cam_from_world.new_tensor([0.0, 0.0, 1.0]) - cam_from_world[:3, 3])
    # What is not drawn may hold anything (a mean on the camera, numbers that overflow), and in the backward pass
    # 0 * inf is NaN: a harmless Gaussian one unit ahead takes its place.
    chosen = visible[:, None]
    harmless = replace(
        gaussians,
        means=torch.where(chosen, gaussians.means, ahead),
        quats=torch.where(chosen, gaussians.quats, gaussians.quats.new_tensor([1.0, 0.0, 0.0, 0.0])),
        scales=torch.where(chosen, gaussians.scales, torch.ones_like(gaussians.scales)),
    )
    footprints = footprints_of(harmless, cam_from_world, width, height, options, probe)
    return replace(footprints, visible=visible)


def project_erp(
    gaussians: Gaussians,
    cam_from_world: Tensor,
    width: int,
    height: int,
    options: RenderOptions,
    probe: Tensor | None = None,
) -> Footprints:
    """Chart model: mean through Eq. 6-7, covariance through their Jacobian (Eq. 3, 5)."""
    rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
    means = gaussians.means @ rotation.T + translation
    squared_radius = (means * means).sum(-1)
    in_front = squared_radius.detach() > options.near**2
    # So near the axis the chart has no derivative worth the name; such a footprint is held constant.
    near_axis = (means[:, 0] ** 2 + means[:, 2] ** 2).detach() < (MIN_COS_LATITUDE**2) * squared_radius.detach()
    means = torch.where(near_axis[:, None], means.detach(), means)
    radius = means.norm(dim=-1)
    centers = pixel_from_angles(*longitude_latitude(means), width, height)
    if probe is not None:
        centers = centers + probe * centers.new_tensor([width / 2, height / 2])
    spread = rotation @ rotation_matrices(gaussians.quats) * gaussians.scales[:, None, :]  # [N, 3, 3], Sigma = A A^T
    jacobian = projection_jacobian(means, width, height, min_cos_latitude=MIN_COS_LATITUDE)
    half_covariance = jacobian @ spread  # [N, 2, 3]
    var_u, var_v = (half_covariance**2).sum(-1).unbind(-1)
    cov_uv = (half_covariance[:, 0] * half_covariance[:, 1]).sum(-1)
    # det(S) without the cancelling difference var_u var_v - cov_uv^2: Lagrange's identity plus the low-pass terms.
    minors = torch.linalg.cross(half_covariance[:, 0], half_covariance[:, 1])
    determinant = (minors**2).sum(-1) + options.low_pass * (var_u + var_v) + options.low_pass**2
    var_u, var_v = var_u + options.low_pass, var_v + options.low_pass
    conics = torch.stack((var_v, -cov_uv, var_u), dim=-1) / determinant[:, None]
    covariance = torch.stack((var_u, cov_uv, var_v), dim=-1).detach()
    drawn = gaussians.opacities.detach() >= ALPHA_MIN
    boxes = (_square_boxes if options.bounds == "square" else _exact_boxes)(
        centers.detach(), covariance, gaussians.opacities.detach()
    )
    on_image = (boxes[:, 3] > boxes[:, 2]) & (boxes[:, 3] > 0) & (boxes[:, 2] < height) & (boxes[:, 1] > boxes[:, 0])
    if not options.wrap:
        on_image &= (boxes[:, 1] > 0) & (boxes[:, 0] < width)
    sound = torch.isfinite(determinant.detach()) & (determinant.detach() > 0)  # else float overflows or nothing spreads
    visible = in_front & drawn & on_image & sound
    return Footprints(centers, conics, gaussians.opacities, radius, radius, boxes, visible, width, height, options.wrap)


def _exact_boxes(centers: Tensor, covariance: Tensor, opacities: Tensor) -> Tensor:
    """Pixels [N, 4] that can have alpha >= 1/255.

    opacity exp(-q / 2) >= 1/255 is the ellipse q <= k with k = 2 ln(255 opacity); its box has half widths sqrt(k var).
    """
    k = 2 * torch.log((opacities / ALPHA_MIN).clamp(min=1))
    slack = 1 + 1e-4  # rounding must never cost a contribution
    half = torch.sqrt(k[:, None] * covariance[:, [0, 2]]) * slack + 1e-3
    first = torch.ceil(centers - half - 0.5)
    end = torch.floor(centers + half - 0.5) + 1
    return torch.stack((first[:, 0], end[:, 0], first[:, 1], end[:, 1]), dim=-1)


def _square_boxes(centers: Tensor, covariance: Tensor, _opacities: Tensor) -> Tensor:
    """Pixels [N, 4] that the published code draws: 3 sigma of the longest axis, rounded out to 16-pixel tiles."""
    var_u, cov_uv, var_v = covariance.unbind(-1)
    middle = 0.5 * (var_u + var_v)
    determinant = var_u * var_v - cov_uv * cov_uv
    longest = middle + torch.sqrt((middle * middle - determinant).clamp(min=0.1))
    radius = torch.ceil(3 * torch.sqrt(longest))[:, None]
    first = 16 * torch.floor((centers - 0.5 - radius) / 16)
    end = 16 * torch.floor((centers - 0.5 + radius + 15) / 16)
    return torch.stack((first[:, 0], end[:, 0], first[:, 1], end[:, 1]), dim=-1)
