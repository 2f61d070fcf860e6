"""Images to look at: ground truth, render and error side by side, and depth as colours."""

import numpy as np
from torch import Tensor

from padgs.render import Rendering

ERROR_FULL_SCALE = 0.25  # error with the brightest colour, the same in every image
ERROR_COLORS = "inferno"  # black = equal; perceptually uniform
DEPTH_COLORS = "magma"  # black = empty or far away


def to_uint8(image: Tensor) -> np.ndarray:
    """Return an image [H, W, 3] of floats as uint8, clamped to [0, 1] and rounded."""
    return (image.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()


def error_image(image: Tensor, truth: Tensor, gain: float = 1.0) -> np.ndarray:
    """Return the absolute difference, averaged over channels, as colours [H, W, 3] uint8; one scale for all images."""
    import matplotlib

    error = (image - truth).detach().abs().mean(-1).cpu().numpy() * (gain / ERROR_FULL_SCALE)
    return matplotlib.colormaps[ERROR_COLORS](np.clip(error, 0, 1), bytes=True)[..., :3]


def comparison_image(truth: Tensor, image: Tensor) -> np.ndarray:
    """Return truth | render | error as one image [H, 3 W, 3] uint8, from floats [H, W, 3]."""
    return np.concatenate((to_uint8(truth), to_uint8(image), error_image(image, truth)), axis=1)


def depth_image(rendering: Rendering, scale: float) -> np.ndarray:
    """Return depth as colours [H, W, 3] uint8, bright is near: s / (d + s) at distance d, for the scene scale s."""
    import matplotlib

    nearness = scale / (rendering.depth + scale) * (1 - rendering.transmittance)
    return matplotlib.colormaps[DEPTH_COLORS](nearness.cpu().numpy(), bytes=True)[..., :3]
