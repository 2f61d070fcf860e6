"""Atomic writes, where only a complete file replaces another, and the one function that opens images."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    from PIL.Image import Image

# Other decoders of Pillow run programs on what a file holds, such as Ghostscript, whatever the name of the file.
IMAGE_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP")


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a hidden path beside `path` to write to; it replaces `path` at the end, or is removed after an error.

    Raises:
        OSError: it was not written, or cannot replace `path`.
    """
    draft = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        yield draft
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file by `atomic_path`, forced to the disk."""
    with atomic_path(path) as draft, draft.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the rename itself must survive a power cut
    finally:
        os.close(folder)


def open_image(file: Path | IO[bytes]) -> Image:
    """Open an image of `IMAGE_FORMATS`, which `with` closes; pixels are decoded when they are needed.

    Raises:
        OSError: it cannot be read, or has another format (PIL.UnidentifiedImageError).
        PIL.Image.DecompressionBombError: it has more pixels than Pillow reads.
    """
    from PIL import Image

    return Image.open(file, formats=IMAGE_FORMATS)
