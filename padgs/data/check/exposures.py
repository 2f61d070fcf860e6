"""How differently views are exposed: the gain of each, from points that several views show."""

from __future__ import annotations

import torch
from torch import Tensor

from padgs.data.check.conventions import POINTS
from padgs.geometry.panorama import project

DARKEST, BRIGHTEST = 8, 250  # pixel values between which a gain shows
ROUNDS = 10  # of medians over points and views, after which they stand


def exposure_gains(poses: Tensor, images: Tensor, points: Tensor) -> Tensor:
    """How often each view [F] doubles the stored values of the median one, a doubling being about two stops of light
    in sRGB; 0 where too little is known.

    A pixel is a gain of its view times a brightness of its point. Both are medians of what the other leaves, so the
    points that something hides from a view, or that shine, are outvoted.

    Args:
        poses: [F, 4, 4] cam_from_world.
        images: [F, H, W, 3] uint8, panoramas reduced to a few hundred pixels width.
        points: [P, 3] world.
    """
    points = points[:: max(1, len(points) // POINTS)].double()
    height, width = images.shape[1:3]
    seen = points @ poses[:, :3, :3].double().mT + poses[:, None, :3, 3].double()
    column, row = project(seen, width, height).long().unbind(-1)
    pixels = images[torch.arange(len(images))[:, None], row.clamp(0, height - 1), column % width].float()
    usable = (pixels.mean(-1) >= DARKEST) & (pixels.amax(-1) <= BRIGHTEST)
    doublings = torch.where(usable, pixels.mean(-1).log2(), torch.nan)  # [F, P]
    gains = doublings.new_zeros(len(doublings))
    for _ in range(ROUNDS):
        of_points = (doublings - gains[:, None]).nanmedian(0).values
        gains = (doublings - of_points).nanmedian(1).values.nan_to_num()
        gains = gains - gains.median()
    return gains
