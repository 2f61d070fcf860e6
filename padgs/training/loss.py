"""The photometric loss (Eq. 16) and the SSIM map it is made of.

loss = lambda <|image - target|> + (1 - lambda) <1 - SSIM>, where <.> is the mean over pixels and channels weighted by
W = row weight M (Eq. 17) x mask. Ignored pixels have weight 0; images are never filled with zeros, which would count as
perfect agreement.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.geometry.distortion import end_row_weight, solid_angle_weight
from padgs.training.native_loss import fits, fused_photometric_loss

WINDOW, SIGMA = 11, 1.5  # SSIM window in pixels
C1, C2 = 0.01**2, 0.03**2
NORMALISATIONS = ("mean", "channel_sum")


def _uniform_weight(height: int, *, dtype: torch.dtype, device: torch.device | str) -> Tensor:
    return torch.ones(height, dtype=dtype, device=device)


ROW_WEIGHTS = {
    "solid_angle": solid_angle_weight,  # M = cos(latitude) of the row's centre
    "uniform": _uniform_weight,  # M = 1
    "end_rows": end_row_weight,  # the released code's M, 0 in the first and last row
}


@dataclass(frozen=True)
class TargetMoments:
    """What the SSIM window sees of the target alone; computed once per view instead of once per iteration."""

    mean: Tensor  # [H, W, C]
    variance: Tensor  # [H, W, C]


def photometric_loss(
    image: Tensor,
    target: Tensor,
    weight: Tensor,
    lambda_l1: float = 0.8,
    *,
    normalisation: str = "mean",
    moments: TargetMoments | None = None,
) -> Tensor:
    """Eq. 16, a scalar; differentiable by `image`, and by `target` where that asks for a gradient.

    Args:
        image: [H, W, 3], not clamped.
        target: [H, W, 3].
        weight: [H, W], or [H, 1] where all pixels of a row weigh the same; >= 0, not 0 everywhere.
        lambda_l1: lambda of Eq. 16.
        normalisation: mean divides by 3 sum(W); channel_sum by sum(W), as the released code does (3 x the mean).
        moments: `target_moments(target)`, if already known; they stop the gradient by the target.

    Raises:
        ValueError: unknown normalisation.
    """
    if normalisation not in NORMALISATIONS:
        raise ValueError(f"unknown normalisation {normalisation!r}; known: {', '.join(NORMALISATIONS)}")
    height, width, channels = image.shape
    total = weight.sum() * (height * width // weight.numel() * (channels if normalisation == "mean" else 1))
    if fits(image):
        loss = fused_photometric_loss(image, target.detach(), weight, lambda_l1, total)
        if target.requires_grad:  # Eq. 16 is symmetric, so that is the derivative by the image with both exchanged
            mirrored = fused_photometric_loss(target, image.detach(), weight, lambda_l1, total)
            loss = loss + (mirrored - mirrored.detach())
        return loss
    return define_loss(image, target, weight, lambda_l1, total, moments)


def define_loss(
    image: Tensor, target: Tensor, weight: Tensor, lambda_l1: float, total: Tensor, moments: TargetMoments | None = None
) -> Tensor:
    """`photometric_loss` in torch, for any dtype and device; `total` is what the weighted sum is divided by."""
    per_channel = lambda_l1 * (image - target).abs() + (1 - lambda_l1) * (1 - ssim_map(image, target, moments))
    return (weight[..., None] * per_channel).sum() / total


def pixel_weight(
    name: str,
    height: int,
    mask: Tensor | None = None,
    *,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Tensor:
    """The weight W of Eq. 16: row weight `name` times the mask, [H, W], or [H, 1] without a mask [H, W].

    Raises:
        ValueError: unknown name, or a mask that leaves no pixel.
    """
    if name not in ROW_WEIGHTS:
        raise ValueError(f"unknown weight {name!r}; known: {', '.join(ROW_WEIGHTS)}")
    rows = ROW_WEIGHTS[name](height, dtype=dtype, device=device)[:, None]
    if mask is None:
        return rows
    if not (mask > 0).any():
        raise ValueError("the mask is 0 everywhere, so no pixel is left to learn from; mend the mask or drop the view")
    return rows * mask.to(rows)


def ssim_map(image: Tensor, target: Tensor, moments: TargetMoments | None = None) -> Tensor:
    """Structural similarity per pixel and channel, [H, W, C]; zeros outside the image, no wrap.

    Variances are E[x^2] - E[x]^2 under the window. Arguments as in `photometric_loss`.
    """
    moments = target_moments(target) if moments is None else moments
    mean_image, mean_square, mean_product = window_mean(torch.stack((image, image * image, image * target)))
    cross, squares = mean_image * moments.mean, mean_image * mean_image
    similarity = (2 * cross + C1) * (2 * (mean_product - cross) + C2)
    return similarity / ((squares + moments.mean**2 + C1) * (mean_square - squares + moments.variance + C2))


def target_moments(target: Tensor) -> TargetMoments:
    """Mean and variance of a target [H, W, C] under the SSIM window."""
    mean, mean_square = window_mean(torch.stack((target, target * target)))
    return TargetMoments(mean, mean_square - mean * mean)


def window_mean(images: Tensor) -> Tensor:
    """Mean of each pixel's neighbourhood under the Gaussian window, [B, H, W, C]; zeros outside."""
    return _WindowMean.apply(images)


class _WindowMean(torch.autograd.Function):
    """The window is symmetric and so is its zero padding: the derivative of the blur is the blur itself."""

    @staticmethod
    def forward(ctx, images: Tensor) -> Tensor:
        return _blur(_blur(images, dim=1), dim=2)

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:
        return window_mean(grad)


def _blur(images: Tensor, dim: int) -> Tensor:
    # A sum of shifted copies: on CPUs 2.5 x faster than a grouped conv2d, and the same code for every dtype and device.
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    taps = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    taps = (taps / taps.sum()).tolist()
    size, half = images.shape[dim], WINDOW // 2
    result = images * taps[half]
    for step in range(1, min(half + 1, size)):
        result.narrow(dim, 0, size - step).add_(images.narrow(dim, step, size - step), alpha=taps[half + step])
        result.narrow(dim, step, size - step).add_(images.narrow(dim, 0, size - step), alpha=taps[half - step])
    return result
