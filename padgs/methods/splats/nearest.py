"""No picture finer than the photographs: what nobody has seen from so near keeps the width of a pixel that did see it.

A filter of a pixel follows the camera that looks, so a camera nearer than all that were trained on, or one with smaller
pixels, would show Gaussians thinner than anything has ever asked of them: needles. They stay as wide as the filter of
the training view makes them that has the finest pixel there, but for what several views resolve together. That is the
3D smoothing filter of Mip-Splatting, for a filter that every training view already applies: in training it changes
nothing.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.methods.splats.model import Splats
from padgs.render.projection import widened_scales
from padgs.scene import View

# Of a pixel: views that overlap resolve more than each of them alone. At four times the pixels of training 0.6 to 0.8
# is best by PSNR and SSIM (docs/plus.md); 1 costs a tenth of LPIPS already at those of training.
RESOLVED = 0.7


def cameras_of(views: Sequence[View]) -> Tensor:
    """Centre, world units, and pixels per radian of each view, [V, 4] float64."""
    rows = [torch.cat((view.center.double().cpu(), torch.tensor([view.camera.focal]).double())) for view in views]
    return torch.stack(rows) if rows else torch.zeros(0, 4, dtype=torch.float64)


@torch.no_grad()
def finest_pixels(means: Tensor, cameras: Tensor) -> Tensor:
    """World units [N] that a pixel covers at each of the means [N, 3], in the camera of [V, 4] that is finest there.

    0 where there is no camera.
    """
    if not len(cameras):
        return torch.zeros_like(means[:, 0])
    each = ((means - camera[:3]).norm(dim=-1) / camera[3] for camera in cameras.to(means))
    return reduce(torch.minimum, each)  # one after the other: N x V numbers may not fit into memory


def no_finer(gaussians: Gaussians, view: View, pixels: Tensor, variance: float) -> Gaussians:
    """Gaussians that a filter of `variance` square pixels of the view makes as wide as one of `pixels` [N] would.

    scale^2 + variance (q^2 - p^2) where the view's own pixel p, world units there, is smaller than q, `RESOLVED` of the
    larger one; the opacity falls as the volume grows. With the low-pass `solid` of the view on top, that of q comes
    out.
    """
    own = (gaussians.means - view.center.to(gaussians.means)).norm(dim=-1) / view.camera.focal
    wide, share = widened_scales(gaussians.scales, variance * ((RESOLVED * pixels).square() - own * own).clamp(min=0))
    return replace(gaussians, scales=wide, opacities=gaussians.opacities * share)


class PixelFilter:
    """The 3D filter of Mip-Splatting as SPaGS has it: each Gaussian as wide as a pixel of the finest training view.

    Its widths have no derivative, and follow the means when they are renewed.

    Attributes:
        variances: [N] world units squared, what each Gaussian is wider by; empty until they are first renewed.
    """

    def __init__(self, pixels: float, cameras: Tensor) -> None:
        """Of so many square pixels of the cameras [V, 4] of `cameras_of`."""
        self.pixels, self.cameras = pixels, cameras
        self.variances = torch.zeros(0)

    def renew(self, means: Tensor) -> None:
        """Measure again what a pixel covers at each of the means [N, 3]."""
        self.variances = self.pixels * finest_pixels(means.detach(), self.cameras).square()

    def __call__(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians wider, and fainter as their volume grows."""
        wide, share = widened_scales(gaussians.scales, self.variances)
        return replace(gaussians, scales=wide, opacities=gaussians.opacities * share)


@torch.no_grad()
def smoothed(splats: Splats, cameras: Tensor, variance: float) -> Splats:
    """Splats for programs that know no such filter: as wide as it makes them in the finest of the cameras [V, 4]."""
    return widened(splats, variance * finest_pixels(splats.means, cameras).square())


@torch.no_grad()
def widened(splats: Splats, variances: Tensor) -> Splats:
    """Splats with variances [N] more each way, and fainter as their volume grows."""
    wide, share = widened_scales(splats.log_scales.exp(), variances)
    new = copy.deepcopy(splats)
    opacity_logits = torch.logit(torch.sigmoid(splats.opacity_logits) * share, eps=1e-6)
    new.load(splats.rows() | {"log_scales": wide.log(), "opacity_logits": opacity_logits})
    return new
