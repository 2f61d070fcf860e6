"""Decoded images of all views of a scene: uint8, one bounded cache, read ahead by a few threads.

Which images are kept and when they are decoded changes nothing about their values.
"""

from __future__ import annotations

from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Protocol

import torch
from torch import Tensor

from padgs.data.images import decode
from padgs.data.resize import area_resize


class Decodable(Protocol):
    """What a store keeps the pixels of; compared and hashed as a key."""

    def decode(self) -> Tensor:
        """The pixels, past the cache."""
        ...


class ImageStore:
    """Least-recently-used cache of decoded images, bounded in bytes. Safe to use from several threads."""

    def __init__(self, limit_bytes: int = 1 << 30, threads: int = 2, device: str = "cpu") -> None:
        """Keep at most `limit_bytes` of pixels on `device`; `threads` = 0 reads nothing ahead."""
        self.limit_bytes, self.threads, self.device = limit_bytes, threads, device
        self.bytes = 0  # kept now
        self.decoded = 0  # images decoded so far
        self._kept: OrderedDict[Decodable, Tensor] = OrderedDict()
        self._pending: dict[Decodable, Future[Tensor]] = {}
        self._lock = Lock()
        self._pool: ThreadPoolExecutor | None = None

    def __contains__(self, image: Decodable) -> bool:
        with self._lock:
            return image in self._kept

    def get(self, image: Decodable) -> Tensor:
        """Pixels [H, W, C] uint8 of an image; shared, not to be written to."""
        with self._lock:
            if image in self._kept:
                self._kept.move_to_end(image)
                return self._kept[image]
            future = self._pending.get(image)
            mine = future is None
            if future is None:
                future = self._pending[image] = Future()
        if mine:
            self._fill(image, future)
        return future.result()

    def prefetch(self, image: Decodable) -> None:
        """Start decoding an image in the background, unless it is there, under way, or enough others are."""
        with self._lock:
            if image in self._kept or image in self._pending or len(self._pending) >= 2 * self.threads:
                return
            if self._pool is None:
                self._pool = ThreadPoolExecutor(self.threads, thread_name_prefix="padgs-read-ahead")
            future: Future[Tensor] = Future()
            self._pending[image] = future
            self._pool.submit(self._fill, image, future)

    def _fill(self, image: Decodable, future: Future[Tensor]) -> None:
        """Decode; an error reaches whoever asks for the image."""
        try:
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


@dataclass(frozen=True)
class StoredImage:
    """An image file at a size, decoded by its store when called: what `View.load_pixels` is."""

    path: Path
    width: int
    height: int
    store: ImageStore
    mode: str = "RGB"  # RGB, or L for masks

    def __call__(self) -> Tensor:
        """Pixels [H, W, 3] uint8 (L: [H, W, 1]); shared, not to be written to."""
        return self.store.get(self)

    def prefetch(self) -> None:
        """Have the pixels decoded in the background."""
        self.store.prefetch(self)

    def decode(self) -> Tensor:
        """Read, decode and reduce, past the cache."""
        return torch.from_numpy(area_resize(decode(self.path, self.mode), self.width, self.height))
