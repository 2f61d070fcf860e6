"""What keeps a Gaussian from falling between the pixels: its footprint, or itself, is widened to about a pixel.

Four kinds. pixels: a variance in the image plane, as in 3D Gaussian splatting; on a panorama that is a circle of the
chart, which spans less and less of the sphere towards the poles. angular: the same angle in every direction of view.
solid: the same, but in 3D and with the opacity lowered as the volume grows: the mass stays, and a thin one fades
instead of swelling (as by the 3D filter of SPaGS, which is of another view, see `padgs.methods.splats.nearest`). fixed: as
angular, but of pixels at 512 per radian whatever the image (the released OP43DGS).

angular and solid add low_pass (r / f)^2 to the 3D covariance, at distance r and with f pixels per radian. Every
projection sees that as a circle of low_pass / f^2: charts and tangent planes do not see along the mean's own direction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Camera
from padgs.render.contract import PUBLISHED_FOCAL, RenderOptions


@dataclass(frozen=True)
class LowPass:
    """One of the kinds, as the kernels apply it."""

    own: float  # variance that the footprint adds: square pixels in a plane, square radians on a tangent plane
    widen: float  # square radians; times r^2 the variance added in 3D, before projecting
    compensate: bool  # widening lowers the opacity


def low_pass_of(options: RenderOptions, camera: Camera) -> LowPass:
    """How `options.low_pass` of its kind is applied for this projection and camera."""
    kind, variance = options.resolved_low_pass_kind, options.low_pass
    if kind == "pixels":
        return LowPass(variance, 0.0, False)
    if kind == "fixed":
        return LowPass(variance / PUBLISHED_FOCAL**2, 0.0, False)
    angle = variance / camera.focal**2
    if kind == "angular" and options.projection == "tangent":  # its covariance is already one of angles
        return LowPass(angle, 0.0, False)
    return LowPass(0.0, angle, kind == "solid")


def widened(gaussians: Gaussians, means: Tensor, low_pass: LowPass) -> Gaussians:
    """Gaussians with scales and opacities after widening in 3D; `means` [N, 3] are those in the camera frame.

    wide^2 = scale^2 + widen r^2; solid: opacity times sqrt(det Sigma / det Sigma') = prod(scale / wide).
    """
    if low_pass.widen == 0:
        return gaussians
    wide, share = wider(gaussians.scales, low_pass.widen * (means * means).sum(-1))
    opacities = gaussians.opacities * share if low_pass.compensate else gaussians.opacities
    return replace(gaussians, scales=wide, opacities=opacities)


def wider(scales: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """Scales [N, 3] with a variance [N] more each way, and the share [N] of the new volume that there was before."""
    wide = torch.sqrt(scales**2 + variance[:, None])
    return wide, (scales / wide).prod(-1)
