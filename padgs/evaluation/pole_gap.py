"""How much worse the poles are than the equator, and how much of that is the scene's own doing.

The pole gap is the WS-PSNR of the rows within 30 degrees of the horizon less that of the rows beyond 75, in dB. Where
there is more detail at the horizon it is negative for a method that treats all directions alike. So it is compared
with the gap of an oracle: the truth itself, blurred alike in all directions until its WS-PSNR is that of the image.
"""

from __future__ import annotations

import math
from itertools import product

import torch
from torch import Tensor

from padgs.evaluation.metrics import band_ws_psnr, ws_psnr
from padgs.geometry.panorama import direction, longitude_latitude, row_latitudes

RINGS, CORNERS = 8, 4  # of the samples that a blur is made of; corners are evenly around, so that nothing is shifted
SHARPEST = 0.05  # pixels of the horizon that the finest blur reaches
COARSEST = 1.0  # radian; nearly one colour
HALVINGS = 10  # of the range of blurs in between, by its logarithm: to less than a percent
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))  # from ring to ring


def pole_gap(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """WS-PSNR of the equator less that of the poles, in dB; NaN where either has no pixel that counts.

    Args:
        image, target: panoramas [H, W, 3] in [0, 1].
        mask: weights [H, W] in [0, 1].
    """
    equator, poles = (band_ws_psnr(image, target, mask, band=band) for band in ("equator", "pole"))
    return equator - poles


def oracle(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor | None:
    """The target [H, W, 3], blurred so that it has the WS-PSNR of the image; None where no blur has.

    A coarser blur is taken to be worse. Of images that are finer than any blur, or worse than nearly one colour, there
    is no oracle.

    Args:
        image, target, mask: as in `pole_gap`.
    """
    wanted = ws_psnr(image, target, mask)
    low, high = (math.log(sigma) for sigma in (SHARPEST * 2 * math.pi / target.shape[1], COARSEST))
    finest, coarsest = (ws_psnr(blurred(target, math.exp(end)), target, mask) for end in (low, high))
    if not coarsest <= wanted <= finest:
        return None
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        if ws_psnr(blurred(target, math.exp(middle)), target, mask) > wanted:
            low = middle
        else:
            high = middle
    return blurred(target, math.exp((low + high) / 2))


def blurred(image: Tensor, sigma: float) -> Tensor:
    """A panorama [H, W, C] through a Gaussian of standard deviation `sigma` in radian, the same in all directions.

    The mean of samples on rings around each direction, whose radii are quantiles of the Gaussian's. They lie alike
    around all columns of a row, so a shift along a row is a phase of its spectrum; between rows it is linear.
    """
    height, width = image.shape[:2]
    spectrum = torch.fft.rfft(image, dim=1)
    orders = torch.arange(spectrum.shape[1], device=image.device)
    beyond = (1 - 2 * (orders % 2)).to(image.dtype)[
        :, None
    ]  # half a turn, as `padgs.geometry.panorama.continued` has it
    spectrum = torch.cat((beyond * spectrum[:1], spectrum, beyond * spectrum[-1:]))
    latitudes = row_latitudes(height, dtype=image.dtype, device=image.device)
    ahead = direction(torch.zeros_like(latitudes), latitudes)
    down = direction(torch.zeros_like(latitudes), latitudes + math.pi / 2)
    east = torch.tensor((1.0, 0.0, 0.0)).to(image)
    total = torch.zeros_like(spectrum[:height])
    for ring, corner in product(range(RINGS), range(CORNERS)):
        radius = sigma * math.sqrt(-2 * math.log1p(-(ring + 0.5) / RINGS))
        angle = ring * GOLDEN_ANGLE + corner * 2 * math.pi / CORNERS
        aside = math.cos(angle) * east + math.sin(angle) * down
        longitude, latitude = longitude_latitude(math.cos(radius) * ahead + math.sin(radius) * aside)
        place = (latitude / math.pi + 0.5) * height + 0.5  # of rows of `spectrum`
        row = place.long()
        between = (place - row)[:, None, None].to(spectrum.dtype)
        turned = torch.polar(torch.ones_like(longitude)[:, None], longitude[:, None] * orders)[..., None]
        total += turned * spectrum[row].lerp(spectrum[row + 1], between)
    return torch.fft.irfft(total / (RINGS * CORNERS), n=width, dim=1)
