"""The bounds of the published rasterizers, `bounds=square` (torch): squares of 16-pixel tiles, cut at the borders.

They allocate the (Gaussian, tile) pairs of a whole image at once; `memory_cap` is what a machine gives them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from padgs.geometry.camera import Panorama
from padgs.geometry.panorama import longitude_latitude, pixel_from_angles, projection_jacobian
from padgs.render.contract import PUBLISHED_FOCAL, RenderOptions

TILE = 16  # pixels
INSTANCE_BYTES = 24  # a key of 8 bytes and a value of 4, before and after sorting; what the sort needs comes on top
LEAST_COS_LATITUDE, LEAST_DIVISOR = 1e-4, 1e-20  # keep the directions of the poles finite


def square_boxes(centers: Tensor, middle: Tensor, determinant: Tensor) -> Tensor:
    """Pixels [N, 4] (first column, end column, first row, end row) within 3 sigma of the longest axis, in whole tiles.

    Args:
        centers: [N, 2] (u, v) pixels.
        middle, determinant: [N] half the trace, and the determinant, of the covariance in square pixels.
    """
    longest = middle + torch.sqrt((middle * middle - determinant).clamp(min=0.1))
    radius = torch.ceil(3 * torch.sqrt(longest))[:, None]
    first = TILE * torch.floor((centers - 0.5 - radius) / TILE)
    end = TILE * torch.floor((centers - 0.5 + radius + TILE - 1) / TILE)
    return torch.stack((first[:, 0], end[:, 0], first[:, 1], end[:, 1]), dim=-1)


def tangent_boxes(means: Tensor, spread: Tensor, determinant: Tensor, low_pass: float, camera: Panorama) -> Tensor:
    """Pixels [N, 4] that the released OP43DGS draws; they grow with the distance of a mean, in whatever units.

    The trace that it takes the radius from is that of the footprint in the panorama, by a Jacobian whose lower row is
    divided by sqrt(x^2 + z^2 r^2) where r^2 sqrt(x^2 + z^2) belongs; the determinant is that of the footprint on a
    tangent plane of 512 pixels per radian.

    Args:
        means: [N, 3] camera frame, world units.
        spread: [N, 3, 3] A with Sigma = A A^T.
        determinant: [N] of the covariance on the tangent plane with its low-pass, in square radians.
        low_pass: the variance that it adds, square radians.
        camera: whose pixels are meant.
    """
    x, y, z = means.unbind(-1)
    right = (x * x + y * y + z * z) * torch.sqrt(x * x + z * z)
    written = torch.sqrt(x * x + z * z * (x * x + y * y + z * z)).clamp(min=LEAST_DIVISOR)
    jacobian = projection_jacobian(means, camera.width, camera.height, min_cos_latitude=LEAST_COS_LATITUDE)
    var_u, var_v = ((jacobian @ spread) ** 2).sum(-1).unbind(-1)
    trace = var_u + (right / written) ** 2 * var_v + 2 * low_pass * PUBLISHED_FOCAL**2
    centers = pixel_from_angles(*longitude_latitude(means), camera.width, camera.height)
    return square_boxes(centers, 0.5 * trace, determinant * PUBLISHED_FOCAL**4)


def is_on_image(boxes: Tensor, width: int, height: int, *, wraps: bool = False) -> Tensor:
    """Which boxes [N, 4] hold a pixel of the image, whose columns may go on across the seam; [N] bool."""
    rows = (boxes[:, 3] > 0) & (boxes[:, 2] < height) & (boxes[:, 3] > boxes[:, 2]) & (boxes[:, 1] > boxes[:, 0])
    return rows if wraps else rows & (boxes[:, 1] > 0) & (boxes[:, 0] < width)


def instances(boxes: Tensor, width: int, height: int) -> int:
    """How many (Gaussian, tile) pairs the boxes [N, 4] make on an image."""
    ends = -(-boxes.new_tensor([width, width, height, height]) // TILE)
    tiles = torch.minimum((boxes / TILE).clamp(min=0), ends)
    return int(((tiles[:, 1] - tiles[:, 0]) * (tiles[:, 3] - tiles[:, 2])).sum())


def check_memory(count: int, options: RenderOptions) -> None:
    """Refuse to draw what the published code could not.

    Raises:
        MemoryError: `count` (Gaussian, tile) pairs take more than `options.memory_cap` bytes.
    """
    needed = count * INSTANCE_BYTES
    if options.memory_cap is not None and needed > options.memory_cap:
        raise MemoryError(
            f"{count:,} (Gaussian, tile) instances of {INSTANCE_BYTES} bytes are {needed:,} bytes at once; "
            f"memory_cap is {options.memory_cap:,}"
        )
