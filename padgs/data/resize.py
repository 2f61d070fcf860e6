"""Area filter: every output pixel is the mean of the input area it covers, fractions of pixels included."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def area_resize(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Reduce an image [H, W, C] uint8 to [height, width, C], rounding to the nearest value.

    Exact for any ratio, which Pillow's BOX is for whole ratios only. Works in bands of rows, so that reducing a
    6080 x 3040 panorama takes a few MB besides input and output.

    Raises:
        ValueError: the output is larger than the input; an area filter only reduces.

    >>> area_resize(np.array([[[0], [90], [30]]], np.uint8), 2, 1)[..., 0]
    array([[30, 50]], dtype=uint8)
    """
    rows, columns = image.shape[:2]
    if width > columns or height > rows:
        raise ValueError(f"cannot reduce {columns}x{rows} to {width}x{height}: that is larger")
    if (rows, columns) == (height, width):
        return image
    row_index, row_weight = _coverage(rows, height)
    column_index, column_weight = _coverage(columns, width)
    out = np.empty((height, width, image.shape[2]), np.uint8)
    band = max(1, (1 << 20) // (columns * image.shape[2]))
    for start in range(0, height, band):
        part = slice(start, min(start + band, height))
        reduced = _weighted_sum(image, row_index[part], row_weight[part], axis=0)
        reduced = _weighted_sum(reduced, column_index, column_weight, axis=1)
        out[part] = np.floor(reduced + np.float32(0.5)).clip(0, 255)
    return out


def _coverage(size_in: int, size_out: int) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Input pixels under each output pixel, [size_out, K], and the share of the output pixel each covers."""
    scale = size_in / size_out
    start = np.arange(size_out)[:, None] * scale
    index = np.floor(start).astype(np.intp) + np.arange(int(np.ceil(scale)) + 1)
    weight = np.clip(np.minimum(start + scale, index + 1) - np.maximum(start, index), 0, None)
    weight /= weight.sum(1, keepdims=True)
    return np.minimum(index, size_in - 1), weight.astype(np.float32)


def _weighted_sum(image: NDArray, index: NDArray[np.intp], weight: NDArray[np.float32], axis: int) -> NDArray:
    shape = (-1, 1, 1) if axis == 0 else (1, -1, 1)
    total = np.take(image, index[:, 0], axis=axis) * weight[:, 0].reshape(shape)
    for k in range(1, index.shape[1]):
        total += np.take(image, index[:, k], axis=axis) * weight[:, k].reshape(shape)
    return total
