"""Atomic writes, where only a complete file replaces another, and the one function that opens images."""

from __future__ import annotations

import os
import re
import shutil
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    from PIL.Image import Image

# Other decoders of Pillow run programs on what a file holds, such as Ghostscript, whatever the name of the file.
IMAGE_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP")

DRAFT = ".padgs-draft-"  # begins the names of files and folders that are not complete
DAY = 86400.0  # seconds


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a hidden path beside `path` to write to; it replaces `path` at the end, or is removed after an error.

    Raises:
        OSError: it was not written, or cannot replace `path`.
    """
    with draft_of(path) as draft:
        yield draft
        os.replace(draft, path)


@contextmanager
def draft_of(path: Path) -> Iterator[Path]:
    """Yield a hidden path beside `path` for a file or folder; what is there at the end is removed.

    Drafts that a killed process left in this folder are removed first: those of processes of this host that have ended,
    and those of other hosts that have not changed for a day.
    """
    owner = f"{DRAFT}{socket.gethostname()}-"
    with suppress(OSError):
        for left in path.parent.glob(f"{DRAFT}*"):
            process = re.match(r"(\d{1,9})-", left.name.removeprefix(owner))
            if _has_ended(int(process[1])) if process else time.time() - left.lstat().st_mtime > DAY:
                _remove(left)
    draft = path.with_name(f"{owner}{os.getpid()}-{path.name[-40:]}")  # the suffix tells programs the format
    try:
        yield draft
    finally:
        _remove(draft)


def _has_ended(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    except OSError:  # of another user
        pass
    return False


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


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
