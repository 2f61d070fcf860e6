"""Pictures of a dual-fisheye camera that nobody has stitched: two circles side by side, 2:1 like a panorama."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from padgs.data.errors import DataError

ROWS = 128  # looked at
OUTSIDE, RIM = 1.06, (0.7, 0.9)  # distances from the middle of a half, in halves of its side
BLACK = 24  # the largest pixel value there
ALL, SOME = 0.98, 0.5  # shares of the pixels


def refuse_dual_fisheye(pixels: NDArray[np.uint8], path: Path) -> None:
    """Refuse the pixels [H, 2H, 3] of a file with black corners around two round pictures.

    Raises:
        DataError: it is no panorama but what two fisheye lenses saw.
    """
    if is_dual_fisheye(pixels):
        raise DataError(
            f"{path} shows two circles side by side: it is the dual-fisheye picture of a 360-degree camera, not a "
            "panorama. Stitch it with the program of the camera's maker, and export equirectangular 2:1 pictures or "
            "video"
        )


def is_dual_fisheye(pixels: NDArray[np.uint8]) -> bool:
    """Whether all is black outside of two circles, and most is not at their rims; pixels [H, 2H, 3]."""
    step = max(1, len(pixels) // ROWS)
    brightest = pixels[::step, ::step].max(-1)
    height, width = brightest.shape
    row = (np.arange(height) + 0.5) / height * 2 - 1
    column = (np.arange(width) + 0.5) / width * 4 % 2 - 1
    distance = np.hypot(row[:, None], column)
    black = brightest <= BLACK
    rim = (distance > RIM[0]) & (distance < RIM[1])
    return bool(black[distance > OUTSIDE].mean() >= ALL and black[rim].mean() <= SOME)
