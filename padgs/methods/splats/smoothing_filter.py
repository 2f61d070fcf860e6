"""3D smoothing filter (Mip-Splatting, Yu et al. 2024): no Gaussian is thinner than the training views could resolve.

A nearer camera, or one with smaller pixels, would show Gaussians as needles that no training view constrained. The
filter keeps them as wide as the pixel filter of the training view with the finest pixel at that place makes them.
"""

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.methods.splats.splats import Splats
from padgs.render.projection import widened_scales
from padgs.scene import View

# Share of a pixel: overlapping views resolve more than each one alone. At four times the pixels of training, 0.6 to 0.8
# is best by PSNR and SSIM (docs/plus.md); 1 costs a tenth of LPIPS at the pixels of training. The same is best for
# renders with 2 x 2 samples, whose low-pass is narrower: bedroom, at 2 and 4 times the pixels.
RESOLVED_PIXEL = 0.7


def cameras_of(views: Sequence[View]) -> Tensor:
    """Return centre (world units) and pixels per radian of each view, [V, 4] float64."""
    rows = [torch.cat((view.center.double().cpu(), torch.tensor([view.camera.focal]).double())) for view in views]
    return torch.stack(rows) if rows else torch.zeros(0, 4, dtype=torch.float64)


@torch.no_grad()
def finest_pixels(means: Tensor, cameras: Tensor) -> Tensor:
    """Return the width [N] in world units of the finest pixel of cameras [V, 4] at means [N, 3]; 0 without cameras."""
    if not len(cameras):
        return torch.zeros_like(means[:, 0])
    widths = ((means - camera[:3]).norm(dim=-1) / camera[3] for camera in cameras.to(means))
    return reduce(torch.minimum, widths)  # camera by camera: N x V numbers may not fit into memory


def smoothed_for_view(gaussians: Gaussians, view: View, pixels: Tensor, variance: float) -> Gaussians:
    """Return Gaussians that a `solid` low-pass of the view makes as wide as training views with `pixels` [N] would.

    scale^2 + variance (q^2 - p^2) where the view's own pixel p at the mean, world units, is smaller than q,
    `RESOLVED_PIXEL` of the finest training pixel. Opacity falls as the volume grows.
    """
    own = (gaussians.means - view.center.to(gaussians.means)).norm(dim=-1) / view.camera.focal
    missing = ((RESOLVED_PIXEL * pixels).square() - own * own).clamp(min=0)
    wide, share = widened_scales(gaussians.scales, variance * missing)
    return replace(gaussians, scales=wide, opacities=gaussians.opacities * share)


class SmoothingFilter:
    """3D filter as in SPaGS: adds a share of the finest training pixel to every Gaussian, in training and rendering.

    The added `values` [N], world units squared, have no derivative and follow the means whenever they are updated.
    """

    def __init__(self, square_pixels: float, cameras: Tensor) -> None:
        """Set the variance in square pixels of the cameras [V, 4] from `cameras_of`."""
        self.square_pixels, self.cameras = square_pixels, cameras
        self.values = torch.zeros(0)

    def update(self, means: Tensor) -> None:
        """Measure the finest pixel at each of the means [N, 3]."""
        self.values = self.square_pixels * finest_pixels(means.detach(), self.cameras).square()

    def __call__(self, gaussians: Gaussians) -> Gaussians:
        """Return widened Gaussians; opacity falls as the volume grows."""
        wide, share = widened_scales(gaussians.scales, self.values)
        return replace(gaussians, scales=wide, opacities=gaussians.opacities * share)


@torch.no_grad()
def widened(splats: Splats, variances: Tensor) -> Splats:
    """Return splats with `variances` [N] added along each axis; opacity falls as the volume grows."""
    wide, share = widened_scales(splats.log_scales.exp(), variances)
    new = copy.deepcopy(splats)
    opacity_logits = torch.logit(torch.sigmoid(splats.opacity_logits) * share, eps=1e-6)
    new.load(splats.rows() | {"log_scales": wide.log(), "opacity_logits": opacity_logits})
    return new
