"""Pictures for people: the truth, the render and where they differ, side by side."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from padgs.render import Rendering

ERROR_FULL_SCALE = 0.25  # an error of a quarter of the range or more has the brightest colour, in every picture alike
ERROR_COLORS = "inferno"  # black = equal; brightness grows evenly with the error
DEPTH_COLORS = "magma"  # black = nothing, or far away


def eight_bit(image: Tensor) -> np.ndarray:
    """An image [H, W, 3] of floats as uint8, clamped to [0, 1] and rounded."""
    return (image.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()


def error_picture(image: Tensor, truth: Tensor) -> np.ndarray:
    """Absolute difference, mean over the channels, as colours [H, W, 3] uint8; one scale for all pictures."""
    import matplotlib

    error = (image - truth).detach().abs().mean(-1).cpu().numpy() / ERROR_FULL_SCALE
    return matplotlib.colormaps[ERROR_COLORS](np.clip(error, 0, 1), bytes=True)[..., :3]


def comparison(truth: Tensor, image: Tensor) -> np.ndarray:
    """truth | render | error as one picture [H, 3 W, 3] uint8, from floats [H, W, 3]."""
    return np.concatenate((eight_bit(truth), eight_bit(image), error_picture(image, truth)), axis=1)


def depth_picture(rendering: Rendering, unit: float) -> np.ndarray:
    """Depth as colours [H, W, 3] uint8, bright is near: u / (d + u) at distance d, half of the scale at the unit u."""
    import matplotlib

    nearness = unit / (rendering.depth + unit) * (1 - rendering.transmittance)
    return matplotlib.colormaps[DEPTH_COLORS](nearness.cpu().numpy(), bytes=True)[..., :3]
