"""How one Gaussian becomes a footprint on the panorama (torch). Entries of `PROJECTIONS`.

erp: the chart model of OmniGS, ODGS and PaD-GS. The projected covariance is J Sigma J^T + low_pass I with the Jacobian
J of Eq. 6-7 at the mean (Eq. 3), and q = delta^T S^-1 delta in pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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
    half_extents: Tensor  # [N, 2] pixels: |delta| beyond which the footprint is cut
    visible: Tensor  # [N] bool
    width: int
    height: int
    wrap: bool

    def touches_rows(self, indices: Tensor, first_row: int, last_row: int) -> Tensor:
        """Which of the Gaussians [K] may reach the pixel centres of rows first_row .. last_row - 1, [K] bool."""
        v, half = self.centers[indices, 1].detach(), self.half_extents[indices, 1]
        return (v + half >= first_row + 0.5) & (v - half <= last_row - 0.5)

    def squared_distance(self, indices: Tensor, first_row: int, last_row: int) -> tuple[Tensor, Tensor]:
        """Squared distance q of each Gaussian [K] at each pixel centre of some rows, and whether it is in bounds.

        Returns:
            q [rows, W, K], inside [rows, W, K] bool.
        """
        centers, conics, half = self.centers[indices], self.conics[indices], self.half_extents[indices]
        rows = torch.arange(first_row, last_row, dtype=centers.dtype, device=centers.device) + 0.5
        columns = torch.arange(self.width, dtype=centers.dtype, device=centers.device) + 0.5
        dv = rows[:, None, None] - centers[:, 1]
        du = columns[None, :, None] - centers[:, 0]
        if self.wrap:  # into [-W/2, W/2)
            turns = torch.floor((du.detach() + self.width / 2) / self.width)
            du = du - turns * self.width
        a, b, c = conics.unbind(-1)
        q = a * du * du + 2 * b * du * dv + c * dv * dv
        return q, (du.detach().abs() <= half[:, 0]) & (dv.detach().abs() <= half[:, 1])


def project(
    gaussians: Gaussians,
    cam_from_world: Tensor,
    width: int,
    height: int,
    options: RenderOptions,
    probe: Tensor | None = None,
) -> Footprints:
    """Footprints under `options.projection`; arguments as in `padgs.render.render`."""
    return lookup(PROJECTIONS, options.projection, "projection")(
        gaussians, cam_from_world, width, height, options, probe
    )


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
    # A culled mean may lie on the camera, where nothing is differentiable: move it before any division.
    means = torch.where(in_front[:, None], means, means.new_tensor([0.0, 0.0, 1.0]))
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
    half_extents, drawn = _half_extents(var_u.detach(), var_v.detach(), cov_uv.detach(), gaussians, options)
    v = centers[:, 1].detach()
    u = centers[:, 0].detach()
    on_image = (v + half_extents[:, 1] >= 0.5) & (v - half_extents[:, 1] <= height - 0.5)
    if not options.wrap:
        on_image &= (u + half_extents[:, 0] >= 0.5) & (u - half_extents[:, 0] <= width - 0.5)
    visible = in_front & drawn & on_image & torch.isfinite(conics.detach()).all(-1)
    return Footprints(
        centers, conics, gaussians.opacities, radius, radius, half_extents, visible, width, height, options.wrap
    )


def _half_extents(
    var_u: Tensor, var_v: Tensor, cov_uv: Tensor, gaussians: Gaussians, options: RenderOptions
) -> tuple[Tensor, Tensor]:
    """Half widths [N, 2] in pixels of the box that is drawn, and which Gaussians are drawn at all [N]."""
    opacities = gaussians.opacities.detach()
    if options.bounds == "square":
        middle = 0.5 * (var_u + var_v)
        determinant = var_u * var_v - cov_uv * cov_uv
        longest = middle + torch.sqrt((middle * middle - determinant).clamp(min=0.1))
        radius = torch.ceil(3 * torch.sqrt(longest))
        return torch.stack((radius, radius), dim=-1), torch.ones_like(radius, dtype=torch.bool)
    # opacity exp(-q / 2) >= 1/255  <=>  q <= k; the box of that ellipse has half widths sqrt(k var).
    drawn = opacities >= ALPHA_MIN
    k = 2 * torch.log((opacities / ALPHA_MIN).clamp(min=1))
    slack = 1 + 1e-4  # rounding must never cost a contribution
    return torch.sqrt(k[:, None] * torch.stack((var_u, var_v), dim=-1)) * slack + 1e-3, drawn
