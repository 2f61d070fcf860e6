"""Image metrics of panoramas, per pixel of the image and per solid angle of the sphere.

Every metric is a function of (image, target, mask): floats [H, W, 3] in [0, 1] (nothing is clamped here) and a weight
[H, W] in [0, 1] or None. A mask is a *weight*: 0 leaves a pixel out of numerator and denominator, so masked pixels
change no metric. (Filling masked pixels of both images with 0 instead would add tenths of a dB.) If the weights sum to
0, the metric is NaN.

Names: `ws_` means weighted by solid angle, M = cos(latitude) of each row (Eq. 17).
"""

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from padgs.evaluation import BANDS
from padgs.geometry.distortion import solid_angle_weight
from padgs.geometry.panorama import pad_panorama, row_latitudes
from padgs.training.loss import ssim_map

Metric = Callable[[Tensor, Tensor, Tensor | None], Tensor]

FLAT = 1e-12  # variance of a channel without contrast, whose gain is undefined
WINDOW_RADIUS = 5  # half of the 11 x 11 window of SSIM


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the peak signal-to-noise ratio in dB, -10 log10 of the mean square error over all pixels and channels.

    >>> psnr(torch.full((2, 4, 3), 1.0), torch.zeros(2, 4, 3)).item()  # -10 log10(1)
    -0.0
    """
    return -10 * torch.log10(weighted_mean((image - target) ** 2, _ones(image) if mask is None else mask))


def ws_psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the PSNR in dB with each row weighted by its solid angle (Sun, Lu, Yu 2017)."""
    return psnr(image, target, sphere_weight(image, mask))


def ws_psnr_fitted(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return `ws_psnr` after fitting gain and offset of each channel to the target: the error besides exposure."""
    weight = sphere_weight(image, mask)[..., None]
    weight = weight / weight.sum()
    image = torch.where(weight == 0, 0, image)
    means = [(of * weight).sum((0, 1)) for of in (image, target)]
    seen, true = (of - mean for of, mean in zip((image, target), means, strict=True))
    gain = (seen * true * weight).sum((0, 1)) / (seen.square() * weight).sum((0, 1)).clamp(min=FLAT)
    return ws_psnr(gain * seen + means[1], target, mask)


def band_ws_psnr(image: Tensor, target: Tensor, mask: Tensor | None = None, *, band: str) -> Tensor:
    """Return `ws_psnr` of the rows whose centres lie in a latitude band of `BANDS`; NaN if there is no such row."""
    inside = band_rows(image.shape[0], band, device=image.device)
    return psnr(image, target, sphere_weight(image, mask) * inside[:, None])


def ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean SSIM of the flat image (as the 3DGS code); a window counts as its smallest mask value."""
    padded = None if mask is None else torch.nn.functional.pad(mask, (WINDOW_RADIUS,) * 4, value=1.0)
    weight = _ones(image) if padded is None else _whole_windows(padded)
    return weighted_mean(ssim_map(image, target), weight)


def ws_ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return WS-SSIM (Zhou et al. 2018): SSIM by solid angle, with windows that continue across seam and poles."""
    r = WINDOW_RADIUS
    padded = ssim_map(pad_panorama(image, r), pad_panorama(target, r))
    whole = None if mask is None else _whole_windows(pad_panorama(mask, r))
    return weighted_mean(padded[r:-r, r:-r], sphere_weight(image, whole))


def seam(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the seam error: the error of the step across the seam relative to steps inside the image.

    The mean over rows of |step of the image - step of the target| between the last and the first column, divided by
    the same for all neighbouring columns inside. Rows have the square of their solid angle as weight, one factor for
    each pixel of a step. 1 = no visible seam; NaN if all steps inside are exact.
    """
    difference = image - target
    steps = (difference - difference.roll(1, dims=1)).abs()  # column 0: across the seam
    weight = sphere_weight(image, mask)
    weight = weight * weight.roll(1, dims=1)
    inside = weighted_mean(steps[:, 1:], weight[:, 1:])
    return weighted_mean(steps[:, :1], weight[:, :1]) / inside


def mean_color(target: Tensor, weight: Tensor) -> Tensor:
    """Return the PSNR of the target's mean colour, both by weight [H, W]: the score of a model that learned nothing."""
    color = (target * weight[..., None]).sum((0, 1)) / weight.sum()
    return psnr(color.expand_as(target), target, weight)


METRICS: dict[str, Metric] = {
    "psnr": psnr,
    "ssim": ssim,
    "ws_psnr": ws_psnr,
    "ws_ssim": ws_ssim,
    **{f"ws_psnr_{band}": partial(band_ws_psnr, band=band) for band in BANDS},
    "seam": seam,
}
# Of photographs; metrics by solid angle take it as a mask, and those of latitudes and of a seam are missing.
PHOTOGRAPH_METRICS: dict[str, Metric] = {"psnr": psnr, "ssim": ssim, "ws_psnr": psnr, "ws_ssim": ssim}


def sphere_weight(image: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the solid-angle weight of each pixel times its mask, [H, W]."""
    rows = solid_angle_weight(image.shape[0], dtype=image.dtype, device=image.device)[:, None]
    return rows.expand(image.shape[:2]) if mask is None else rows * mask


def band_rows(height: int, band: str, *, device: torch.device | str = "cpu") -> Tensor:
    """Return which rows of a panorama have their centre in a latitude band, [H] bool."""
    degrees = row_latitudes(height, dtype=torch.float64, device=device) * (180 / math.pi)
    return torch.stack([(degrees >= low) & (degrees < high) for low, high in BANDS[band]]).any(0)


def weighted_mean(values: Tensor, weight: Tensor) -> Tensor:
    """Return the mean of values [H, W, C] over channels and, by weight [H, W], pixels; NaN if weights sum to 0.

    Values without weight may be NaN.
    """
    return (torch.where(weight > 0, values.mean(-1), 0) * weight).sum() / weight.sum()


def _ones(image: Tensor) -> Tensor:
    return torch.ones_like(image[..., 0])


def _whole_windows(padded_mask: Tensor) -> Tensor:
    """Return the smallest mask value [H, W] in the window around each pixel of a mask [H + 10, W + 10]."""
    side = 2 * WINDOW_RADIUS + 1
    return -torch.nn.functional.max_pool2d(-padded_mask[None, None], side, stride=1)[0, 0]
