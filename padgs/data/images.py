"""Image files: checks, decoding and saving.

A panorama is an 8-bit colour image, twice as wide as high, stored upright. Other files are refused when the scene is
loaded, before any training.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from padgs.data.capture import DataError
from padgs.files import IMAGE_FORMATS, open_image

EXTENSIONS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
_ORIENTATION = 0x0112  # EXIF tag; 1 = stored upright
_GREY = ("1", "L", "LA", "La")
GREY = 128  # libjpeg fills missing rows with it
FILLING = b"\x55" * 2048  # decodes to a few pixels of a JPEG scan


@dataclass(frozen=True)
class ImageFile:
    """A checked image file: its size in pixels and the digest of its bytes."""

    path: Path
    width: int
    height: int
    digest: str


def inspect(path: Path, *, mask: bool = False) -> ImageFile:
    """Check that a file is a usable panorama, or mask, which may be grey. Decodes only if the header is not enough.

    Raises:
        DataError: missing, unreadable, not an image, truncated, rotated by EXIF, 16-bit, grey, CMYK, not 2:1, or partly
            transparent.
    """
    data = read_bytes(path)
    try:
        with open_image(BytesIO(data)) as image:
            width, height, mode, has_alpha = image.width, image.height, image.mode, "A" in image.getbands()
            orientation = 1 if image.format == "PNG" and "exif" not in image.info else image.getexif().get(_ORIENTATION)
            deep = _is_deep(image, data)
    except Image.DecompressionBombError as error:
        raise DataError(
            f"{path} has more than {2 * (Image.MAX_IMAGE_PIXELS or 0) / 1e6:.0f} million pixels, the most that are "
            "read; reduce it (`mogrify -resize 50%`)"
        ) from error
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        formats = ", ".join(IMAGE_FORMATS)
        raise DataError(f"{path} is not an image in {formats} ({error}); convert, replace or remove it") from error
    if orientation not in (None, 0, 1):
        raise DataError(
            f"{path} carries EXIF orientation {orientation}: its pixels are stored rotated, and it is unknown which "
            "orientation the poses refer to; store it upright (`mogrify -auto-orient`) or remove the flag"
        )
    if deep and not mask:
        raise DataError(f"{path} has 16 bits or more per channel ({mode}); convert it to 8 bits (`mogrify -depth 8`)")
    if mode in _GREY and not mask:
        raise DataError(f"{path} is grey ({mode}); panoramas must be colour, 3 x 8 bits: convert it or remove it")
    if mode == "CMYK":
        raise DataError(f"{path} is CMYK; convert it to RGB")
    refuse_other_shapes(width, height, path)
    if _looks_cut(data) or has_alpha:
        _decode(data, path, "L" if mask else "RGB")
    return ImageFile(path, width, height, hashlib.sha256(data).hexdigest())


def refuse_other_shapes(width: int, height: int, path: Path) -> None:
    """Refuse image sizes that are not 2:1.

    Raises:
        DataError: the size is not that of a full panorama.
    """
    if width != 2 * height:
        raise DataError(
            f"{path} is {width}x{height}, which is not 2:1; an equirectangular panorama covers 360 x 180 degrees "
            "(a dual-fisheye or cropped image must be stitched or padded first)"
        )


def decode(path: Path, mode: str = "RGB") -> NDArray[np.uint8]:
    """Decode an image file to uint8 pixels, [H, W, 3] for RGB and [H, W, 1] for L.

    Raises:
        DataError: the file is truncated, damaged, or partly transparent.
    """
    return _decode(read_bytes(path), path, mode)


def save_png(pixels: Tensor, path: Path) -> None:
    """Save pixels [H, W, 3] or [H, W] in 0..255, rounded, as PNG; creates the folder if needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels.round().to(torch.uint8).cpu().numpy()).save(path)


def _decode(data: bytes, path: Path, mode: str) -> NDArray[np.uint8]:
    try:
        with open_image(BytesIO(data)) as image:
            image.load()
            transparent = "A" in image.getbands() and np.asarray(image.getchannel("A")).min() < 255
            pixels = np.array(_eight_bit(image).convert(mode))
            cut = _misses_pixels(image, data, pixels)
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(f"{path} is cut short or damaged ({error}); copy it again or remove it") from error
    if cut:
        raise DataError(f"{path} is cut short, although it has an end marker; copy it again or remove it")
    if transparent:
        remedy = "say what to ignore in a mask file (data.mask)" if mode == "RGB" else "paint what to ignore black (0)"
        raise DataError(f"{path} has transparent pixels; save it without alpha, and {remedy}")
    return pixels if mode == "RGB" else pixels[..., None]


def _eight_bit(image: Image.Image) -> Image.Image:
    """Scale 16-bit masks to 8 bits; Pillow's own conversion would clip them."""
    if not image.mode.startswith("I"):
        return image
    return Image.fromarray((np.asarray(image).astype(np.int64) >> 8).clip(0, 255).astype(np.uint8))


def read_bytes(path: Path) -> bytes:
    """Read a file.

    Raises:
        DataError: missing, unreadable or empty.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise DataError(f"{path} does not exist") from error
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}); check its permissions") from error
    if not data:
        raise DataError(f"{path} is empty (0 bytes); copy it again or remove it")
    return data


def _is_deep(image: Image.Image, data: bytes) -> bool:
    """Return whether there are more than 8 bits per channel. Pillow silently opens 16-bit RGB PNGs as 8-bit."""
    if image.format == "PNG":
        return data[24] > 8
    if image.format == "TIFF":
        bits = getattr(image, "tag_v2", {}).get(258, (8,))
        return max(bits if isinstance(bits, tuple) else (bits,)) > 8
    return image.mode in ("I", "F") or image.mode.startswith("I;")


def _looks_cut(data: bytes) -> bool:
    """Return whether a JPEG or PNG seems truncated; a cheap test, to be confirmed by decoding."""
    if data[:2] == b"\xff\xd8":  # a scan without an end-of-image marker behind it
        return data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    return data[:4] == b"\x89PNG" and b"IEND" not in data[-4096:]


def _misses_pixels(image: Image.Image, data: bytes, pixels: NDArray[np.uint8]) -> bool:
    """Return whether a JPEG ends before its last pixel; libjpeg then invents the rest, grey if not progressive.

    Bytes added before the end marker become pixels in a truncated file, and are ignored in a complete one.
    """
    if image.format != "JPEG" or not ("progressive" in image.info or (pixels[-1] == GREY).all()):
        return False
    end = data.rfind(b"\xff\xd9")
    with open_image(BytesIO(data[:end] + FILLING + data[end:])) as longer:
        return not np.array_equal(np.array(longer.convert("RGB" if pixels.shape[-1] == 3 else "L")), pixels)


# Detection of dual-fisheye images: radii are relative to half the side of each circle's square.
FISHEYE_ROWS = 128  # sampled
OUTSIDE, RIM = 1.06, (0.7, 0.9)
BLACK = 24  # largest pixel value that counts as black
MIN_BLACK_OUTSIDE, MAX_BLACK_RIM = 0.98, 0.5  # shares of the pixels


def refuse_dual_fisheye(pixels: NDArray[np.uint8], path: Path) -> None:
    """Refuse pixels [H, 2H, 3] of an unstitched dual-fisheye camera.

    Raises:
        DataError: the image shows two circles on black instead of a panorama.
    """
    if is_dual_fisheye(pixels):
        raise DataError(
            f"{path} shows two circles side by side: it is the dual-fisheye image of a 360-degree camera, not a "
            "panorama. Stitch it with the program of the camera's maker, and export equirectangular 2:1 images or video"
        )


def is_dual_fisheye(pixels: NDArray[np.uint8]) -> bool:
    """Return whether pixels [H, 2H, 3] are black outside two circles, but mostly not at their rims."""
    step = max(1, len(pixels) // FISHEYE_ROWS)
    brightest = pixels[::step, ::step].max(-1)
    height, width = brightest.shape
    row = (np.arange(height) + 0.5) / height * 2 - 1
    column = (np.arange(width) + 0.5) / width * 4 % 2 - 1
    distance = np.hypot(row[:, None], column)
    black = brightest <= BLACK
    rim = (distance > RIM[0]) & (distance < RIM[1])
    return bool(black[distance > OUTSIDE].mean() >= MIN_BLACK_OUTSIDE and black[rim].mean() <= MAX_BLACK_RIM)
