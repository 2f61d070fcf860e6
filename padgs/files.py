"""Atomic writes, where only a complete file replaces another, and the one function that opens images."""

from __future__ import annotations

import errno
import hashlib
import math
import os
import re
import shutil
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import IO, TYPE_CHECKING
from unicodedata import category, normalize

if TYPE_CHECKING:
    from PIL.Image import Image

# Other decoders of Pillow run programs on what a file holds, such as Ghostscript, whatever the name of the file.
IMAGE_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP")
IMAGE_FOLDERS = ("images", "imgs", "image", "rgb")
# First bytes of formats that Pillow does not know.
_OTHER_FORMATS = {b"ftyp": "HEIC, AVIF or video", b"%PDF": "PDF", b"\0\0\0\x0cJXL": "JPEG XL", b"<": "HTML, XML or SVG"}
# Errors of Pillow
DAMAGE = (OSError, SyntaxError, ValueError, TypeError, LookupError, EOFError, ArithmeticError, struct.error)
MAX_PIXELS = 180_000_000  # a panorama of 18972x9486

LONGEST = 200  # bytes of `file_name`; file systems take 255, with an ending
DRAFT = ".padgs-draft-"  # begins the names of files and folders that are not complete
DAY = 86400.0  # seconds


def file_name(text: str) -> str:
    """Return a text as a file name without separators and of at most `LONGEST` bytes, so that an ending still fits.

    Letters and vowel signs of all languages stay, since names may differ in them; longer names end with a digest.

    >>> file_name("left/R001 a"), file_name("chart_../../etc"), file_name("客厅 1"), file_name("कमरा")
    ('left-R001-a', 'chart_..-..-etc', '客厅-1', 'कमरा')
    """
    kept = (sign if sign.isalnum() or sign in "._-" or category(sign)[0] == "M" else " " for sign in text)
    name = re.sub(" +", "-", "".join(kept))
    if len(long := name.encode()) > LONGEST:  # which file systems do not accept with an ending
        digest = hashlib.sha256(text.encode(errors="surrogatepass")).hexdigest()[:9]
        name = f"{long[: LONGEST - 10].decode(errors='ignore')}-{digest}"
    return name


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a hidden path beside `path` to write to; it replaces `path` at the end, or is removed after an error."""
    check_place(path)
    with draft_of(path) as draft:
        yield draft
        os.replace(draft, path)


def check_place(path: Path) -> None:
    """Raise an OSError if a file cannot be written, before work that may take minutes."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    with draft_of(path) as draft:
        draft.touch()


def refuse_working_folder(path: Path) -> None:
    """Raise a ValueError for the working folder, a root or a mount point, which nothing can replace."""
    if path.name and os.path.ismount(path):
        raise ValueError(f"{path} is a mount point, which nothing can replace; name a new folder in it")
    if not path.name or (path.is_dir() and path.samefile(Path())):
        raise ValueError(f"{path} is the working folder or a root, which is not replaced; name a new one")


@contextmanager
def draft_of(path: Path) -> Iterator[Path]:
    """Yield a hidden path beside `path` for a file or folder; what is there at the end is removed.

    Drafts that killed processes left in this folder, and that have not changed for a day, are removed first.
    """
    refuse_working_folder(path)
    with suppress(OSError):
        for left in path.parent.glob(f"{DRAFT}*"):
            if time.time() - left.lstat().st_mtime > DAY:
                _remove(left)
    name = f"{DRAFT}{socket.gethostname()}-{os.getpid()}-{path.name[-40:]}"  # the suffix tells programs the format
    draft = path.with_name(name)
    try:
        yield draft
    finally:
        _remove(draft)


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
    with suppress(OSError):  # some file systems cannot
        os.fsync(folder)  # the rename itself must survive a power cut
    os.close(folder)


def read_regular(path: Path) -> bytes:
    """Return the content of a regular file; reading a pipe or a device may never end."""
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    return path.read_bytes()


class ImageError(OSError):
    """An image that is not read. The message names the file, the rule and the way out."""


def open_image(file: Path | IO[bytes], name: object = None) -> Image:
    """Open an image of `IMAGE_FORMATS`, which `with` closes; pixels are decoded when they are needed.

    An ImageError says that it has another format, is damaged, or has more than `MAX_PIXELS` pixels.
    """
    from PIL import Image, UnidentifiedImageError

    name = file if name is None else name
    if isinstance(file, Path) and file.exists() and not file.is_file():
        raise ImageError(f"{name} is not a regular file; replace or remove it")
    Image.MAX_IMAGE_PIXELS = None  # the size is checked below, with a remedy
    try:
        image = Image.open(file, formats=IMAGE_FORMATS)
    except DAMAGE as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        found = _format_of(file)
        why = "" if isinstance(error, UnidentifiedImageError) else f": {error}"
        if found in IMAGE_FORMATS:
            raise ImageError(
                f"{name} is a {found} file of a kind that is not read, or is damaged{why}; convert it to 8 bits per "
                "channel, replace or remove it"
            ) from error
        raise ImageError(
            f"{name} is not an image in {', '.join(IMAGE_FORMATS)} (it is {found}{why}); convert, replace or remove it"
        ) from error
    if image.width * image.height > MAX_PIXELS:
        image.close()
        width = 2 * math.isqrt(MAX_PIXELS // 2)
        raise ImageError(
            f"{name} is too large: it has {image.width * image.height / 1e6:.0f} million pixels "
            f"({image.width}x{image.height}), and at most {MAX_PIXELS / 1e6:.0f} million are read; reduce it to "
            f"{width}x{width // 2} or less (`mogrify -resize {width}x FILE`)"
        )
    return image


def _format_of(file: Path | IO[bytes]) -> str:
    """Return the format of a file by its first bytes, without decoding it."""
    from PIL import Image

    if isinstance(file, Path):
        with file.open("rb") as opened:
            start = opened.read(64)
    else:
        file.seek(0)
        start = file.read(64)
    Image.init()
    for beginning, name in _OTHER_FORMATS.items():
        if start.startswith(beginning, 4 if name.startswith("HEIC") else 0):
            return name
    for name, (_, accepts) in Image.OPEN.items():
        with suppress(Exception):  # of plugins, at too few bytes
            if accepts is not None and accepts(start[:16]):
                return name
    return "of an unknown format"


def folded(path: Path | PurePosixPath | str) -> str:
    """Return a path as it is compared: without case, in one Unicode form."""
    return normalize("NFC", PurePosixPath(path).as_posix()).casefold()


def given_path(given: str, folder: Path) -> Path:
    """Return the path that an option names: from the data set's folder, or else from the working directory."""
    inside, here = folder / given, Path(given).absolute()
    return here if here.exists() and not inside.exists() else inside
