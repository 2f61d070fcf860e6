"""Decoded images of all views: area filter, one bounded cache that a few threads fill in advance, and one on disk.

Caching and prefetching do not change pixel values. The cache on disk holds each image at each size that was asked for,
as raw bytes: decoding and reducing a panorama takes far longer than reading it.
"""

from __future__ import annotations

import hashlib
import os
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from padgs.data.image_metadata import Crop
from padgs.data.images import decode
from padgs.files import atomic_path


def area_resize(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Reduce an image [H, W, C] uint8 to [height, width, C] by an area filter, rounding to the nearest value.

    Every output pixel is the mean of the input area it covers, fractions of pixels included; Pillow's BOX is exact for
    integer ratios only. Works in bands of rows: a 6080 x 3040 panorama takes a few MB besides input and output.

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
    """Return indices [size_out, K] of the input pixels under each output pixel, and their weights."""
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


def cache_root() -> Path:
    """Return the folder of all caches: $PADGS_CACHE, or ~/.cache/padgs."""
    return Path(os.environ.get("PADGS_CACHE") or Path.home() / ".cache" / "padgs")


class Decodable(Protocol):
    """A cache key of `ImageStore` that can compute its pixels."""

    def decode(self) -> Tensor:
        """Return the pixels without the cache."""
        ...


class ImageStore:
    """Least-recently-used cache of decoded images: `limit_bytes` of pixels on `device`, and all in `folder` if given.

    It is thread-safe. With `threads` = 0 nothing is prefetched.
    """

    def __init__(
        self, limit_bytes: int = 1 << 30, threads: int = 2, device: str = "cpu", folder: Path | None = None
    ) -> None:
        self.limit_bytes, self.threads, self.device, self.folder = limit_bytes, threads, device, folder
        self.bytes = 0
        self.decoded = 0  # number of decoded images
        self._kept: OrderedDict[Decodable, Tensor] = OrderedDict()
        self._pending: dict[Decodable, Future[Tensor]] = {}
        self._lock = Lock()
        self._pool: ThreadPoolExecutor | None = None

    def __contains__(self, image: Decodable) -> bool:
        with self._lock:
            return image in self._kept

    def get(self, image: Decodable) -> Tensor:
        """Return the pixels [H, W, C] uint8 of an image; shared, do not modify."""
        with self._lock:
            if image in self._kept:
                self._kept.move_to_end(image)
                return self._kept[image]
            is_mine = image not in self._pending
            future = self._pending.setdefault(image, Future())
        if is_mine:
            self._fill(image, future)
        return future.result()

    def prefetch(self, image: Decodable) -> None:
        """Decode an image in the background, unless it is cached or pending, or too many others are pending."""
        with self._lock:
            if image in self._kept or image in self._pending or len(self._pending) >= 2 * self.threads:
                return
            if self._pool is None:
                self._pool = ThreadPoolExecutor(self.threads, thread_name_prefix="padgs-prefetch")
            self._pool.submit(self._fill, image, self._pending.setdefault(image, Future()))

    def _fill(self, image: Decodable, future: Future[Tensor]) -> None:
        """Decode into the cache; an error is raised where the future's result is used."""
        try:
            if self.folder is not None and isinstance(image, StoredImage):
                pixels = self._stored(image, self.folder).to(self.device)
            else:
                pixels = image.decode().to(self.device)
        except BaseException as error:
            with self._lock:
                del self._pending[image]
            future.set_exception(error)
            return
        with self._lock:
            del self._pending[image]
            self.decoded += 1
            if pixels.nbytes <= self.limit_bytes:
                while self.bytes + pixels.nbytes > self.limit_bytes:
                    self.bytes -= self._kept.popitem(last=False)[1].nbytes
                self._kept[image] = pixels
                self.bytes += pixels.nbytes
        future.set_result(pixels)

    def _stored(self, image: StoredImage, folder: Path) -> Tensor:
        """Read the pixels of an image from disk, or decode and write them; a full disk loses only the file."""
        with suppress(OSError, ValueError):
            path, shape = image.file(folder)
            return torch.from_numpy(np.fromfile(path, np.uint8).reshape(shape))
        pixels = image.decode()
        with suppress(OSError), atomic_path(image.file(folder)[0]) as draft:
            pixels.numpy().tofile(draft)
        return pixels


@dataclass(frozen=True)
class StoredImage:
    """An image file at a size, decoded by its store when called; used as `View.load_pixels`."""

    path: Path
    width: int
    height: int
    store: ImageStore
    mode: str = "RGB"  # RGB, or L for masks
    within: Crop | None = None  # of a mask, as in `padgs.data.images.inspect`

    def __call__(self) -> Tensor:
        """Return pixels [H, W, 3] uint8 (L: [H, W, 1]); shared, do not modify."""
        return self.store.get(self)

    def prefetch(self) -> None:
        """Decode the pixels in the background."""
        self.store.prefetch(self)

    def decode(self) -> Tensor:
        """Read, decode and reduce without the cache."""
        return torch.from_numpy(area_resize(decode(self.path, self.mode, self.within), self.width, self.height))

    def file(self, folder: Path) -> tuple[Path, tuple[int, int, int]]:
        """Return the file of the pixels in a cache on disk, named by the image file, its time and the size."""
        status = os.stat(self.path)
        text = f"{self.path.resolve()}|{status.st_size}|{status.st_mtime_ns}|{self.mode}|{self.width}x{self.height}"
        text += "" if self.within is None else f"|{self.within}"
        name = f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.raw"
        return folder / name, (self.height, self.width, 3 if self.mode == "RGB" else 1)
