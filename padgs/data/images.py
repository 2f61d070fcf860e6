"""Image files: checks, decoding and saving.

A panorama is an 8-bit colour image in sRGB, twice as wide as high, stored upright; a part of one that says so
(`image_metadata.Crop`) is padded. Other files are refused when the scene is loaded, before any training.
"""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from padgs.data import image_metadata
from padgs.data.capture import DataError, listed, refuse_special
from padgs.data.image_metadata import Crop, crop_of
from padgs.files import DAMAGE, ImageError, open_image

EXTENSIONS = (".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".tif", ".tiff", ".webp", ".bmp")
_COLOUR = ("RGB", "RGBA", "RGBa", "RGBX", "P", "PA", "YCbCr")
_GREY = ("1", "L", "LA", "La")
_ALPHA = ("RGBA", "RGBa", "LA", "La", "PA")
GREY = 128  # libjpeg fills missing rows with it
FILLING = b"\x55" * 2048  # decodes to a few pixels of a JPEG scan
# Detection of dual-fisheye images: radii are relative to half the side of each circle's square.
FISHEYE_ROWS = 128  # sampled
OUTSIDE, RIM = 1.06, (0.7, 0.9)
LABELS = 32  # a mask without a value as large, but with several, holds the numbers of labels
MIN_AREA = 0.01  # share of a mask that a label covers at least; ramps and soft edges have less of each value
NEARLY_WHITE = 250  # noise of JPEG files reaches down to it
COLOURED = 64  # difference of the channels of a coloured pixel of a mask
BLACK = 24  # largest pixel value that counts as black
MIN_BLACK_OUTSIDE, MAX_BLACK_RIM = 0.98, 0.5  # shares of the pixels


@dataclass(frozen=True)
class ImageFile:
    """A checked image file: size of its panorama in pixels, digest of its bytes, and its statements about itself."""

    path: Path
    width: int
    height: int
    digest: str
    crop: Crop | None = None  # where the stored pixels lie in the panorama; None = they are all of it
    converted: bool = False  # whether other programs read other pixels, because the colours are not sRGB
    format: str = ""  # of the content, which the suffix may not tell: JPEG, PNG, ...


def inspect(path: Path, *, mask: bool = False, panorama: bool = True, within: Crop | None = None) -> ImageFile:
    """Check that a file is a usable panorama, or mask, which may be grey. Decodes only if the header is not enough.

    A DataError says why it is not usable: damage, rotation, several pictures, depth, shape, transparency or colours.
    Photographs of other cameras, and their masks, have any shape (`panorama` is false). `within` is the crop of the
    image of a mask.
    """
    data = read_bytes(path)
    with refused_if_damaged(path), open_image(BytesIO(data), path) as image:
        image_metadata.load_late_chunks(image, data)
        image_metadata.refuse_rotated(image, path)
        image_metadata.refuse_several_pictures(image, path)
        mode = image.mode
        _refuse_other_modes(image, data, path, mask)
        crop = crop_of(image, path, within)
        if crop is not None and not panorama:
            raise DataError(
                f"{path} is a photograph, and says that it is a part of a panorama; remove the metadata "
                "(`exiftool -xmp:all= FILE`)"
            )
        conversion = None if mask else image_metadata.srgb_conversion(image, data, path)
        size = (image.width, image.height) if crop is None else (crop.full_width, crop.full_height)
        may_be_transparent = mode in _ALPHA or "transparency" in image.info
    if panorama:
        refuse_other_shapes(*size, path)
    is_cut = _looks_cut(data)
    if is_cut and data.endswith(bytes(64)):  # decoders take them for pixels
        raise DataError(f"{path} ends in zeros, as after an interrupted download; copy it again or remove it")
    if is_cut or may_be_transparent:
        _decode(data, path, "L" if mask else "RGB")
    return ImageFile(path, *size, hashlib.sha256(data).hexdigest(), crop, conversion is not None, image.format or "")


@contextmanager
def refused_if_damaged(path: Path) -> Iterator[None]:
    """Turn what decoders raise on a file into a DataError that names it."""
    try:
        yield
    except DataError:
        raise
    except ImageError as error:
        raise DataError(str(error)) from error
    except DAMAGE as error:
        raise DataError(f"{path} is cut short or damaged ({error}); copy it again or remove it") from error


def _refuse_other_modes(image: Image.Image, data: bytes, path: Path, mask: bool) -> None:
    mode = image.mode
    if mask:
        if mode not in (*_COLOUR, *_GREY) and not mode.startswith("I;16") and (mode, image.format) != ("I", "PNG"):
            raise DataError(f"{path} has pixels of type {mode}; save masks as grey images with 8 bits (0 to 255)")
        return
    if _is_deep(image, data):
        raise DataError(f"{path} has 16 bits or more per channel ({mode}); convert it to 8 bits (`mogrify -depth 8`)")
    if mode in _GREY:
        raise DataError(f"{path} is grey ({mode}); panoramas must be colour, 3 x 8 bits: convert it or remove it")
    if mode not in _COLOUR:
        raise DataError(f"{path} is {mode}; convert it to RGB (`mogrify -colorspace sRGB`)")


def notes_on(images: Sequence[ImageFile]) -> list[str]:
    """Return what images say of themselves that is worth a note."""
    notes = []
    if cropped := [image for image in images if image.crop is not None]:
        names = listed(image.path.name for image in cropped)
        notes.append(f"images: parts of panoramas by their GPano data, the rest is masked: {names}")
    if converted := [image for image in images if image.converted]:
        notes.append(f"images: converted to sRGB: {listed(image.path.name for image in converted)}")
    return notes


def refuse_other_shapes(width: int, height: int, path: Path) -> None:
    """Refuse image sizes that are not 2:1."""
    if width != 2 * height or not height:
        ratio = width // height if height and width % height == 0 else 0
        eyes = {1: "one above the other", 4: "side by side"}.get(ratio)
        stereo = f"; if it holds two panoramas {eyes} (stereo), cut out one" if eyes else ""
        remedy = f"a dual-fisheye or cropped image must be stitched or padded first{stereo}"
        short, long = sorted((width, height))
        if any(abs(long - shape * short) <= 0.01 * long for shape in (4 / 3, 3 / 2, 16 / 9)):
            remedy = "it has the shape of an ordinary photograph: move it elsewhere"
        if abs(width - 2 * height) <= max(2, width / 50):
            remedy = f"if it is whole, resize it: `mogrify -resize {2 * round(width / 2)}x{round(width / 2)}! FILE`"
        what = "an equirectangular panorama covers 360 x 180 degrees"
        raise DataError(f"{path} is {width}x{height}, which is not 2:1; {what} ({remedy})")


def decode(path: Path, mode: str = "RGB", within: Crop | None = None) -> NDArray[np.uint8]:
    """Decode an image to uint8 pixels, [H, W, 3] in sRGB for RGB, [H, W, 1] for L; a DataError if it is damaged.

    `within` is as in `inspect`.
    """
    return _decode(read_bytes(path), path, mode, within)


def save_png(pixels: Tensor, path: Path, *, compress_level: int = 6) -> None:
    """Save pixels [H, W, 3] or [H, W] in 0..255, rounded, as PNG; creates the folder if needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels.round().to(torch.uint8).cpu().numpy()).save(path, compress_level=compress_level)


def _decode(data: bytes, path: Path, mode: str, within: Crop | None = None) -> NDArray[np.uint8]:
    with refused_if_damaged(path), open_image(BytesIO(data), path) as image:
        image.load()
        transparent = _is_transparent(image)
        convert = image_metadata.srgb_conversion(image, data, path) if mode == "RGB" else None
        crop, stored = crop_of(image, path, within), _eight_bit(image).convert(mode)
        spread = np.ptp(np.asarray(image.convert("RGB")), axis=-1) if mode == "L" and image.mode in _COLOUR else 0
        is_coloured = np.mean(spread > COLOURED) > 1e-3  # whose brightness means nothing; JPEG leaves a few faint ones
        cut = _misses_pixels(image, data, np.asarray(stored))
        converted = stored if convert is None else convert(stored)
        pixels = np.array(converted if crop is None else converted.resize((crop.width, crop.height)))
    if cut:
        raise DataError(f"{path} is cut short, although it has an end marker; copy it again or remove it")
    if transparent:
        remedy = "say what to ignore in a mask file (data.mask)" if mode == "RGB" else "paint what to ignore black (0)"
        raise DataError(f"{path} has transparent pixels; save it without alpha, and {remedy}")
    if is_coloured:
        rule = "a mask is white (use) and black (ignore), or the other way with data.mask=inverted"
        raise DataError(f"{path} is a mask in colours; {rule}: convert it")
    if crop is not None:
        rows = (crop.top, crop.full_height - crop.top - crop.height)
        columns = (crop.left, crop.full_width - crop.left - crop.width)
        pixels = np.pad(pixels, (rows, columns, (0, 0))[: pixels.ndim])
    return pixels if mode == "RGB" else _two_valued(pixels, path)[..., None]


def _two_valued(mask: NDArray[np.uint8], path: Path) -> NDArray[np.uint8]:
    """Return a mask with 255 for the only value that it has besides 0, such as 1; a DataError for labels 0, 1, 2."""
    counts = np.bincount(mask.ravel(), minlength=256)
    values = counts[1:].nonzero()[0] + 1
    rule = "in a mask 255 means use, 0 means ignore"
    if len(values) > 1 and values[-1] < LABELS:
        raise DataError(f"{path} has no value above {values[-1]}, as images of labels have; {rule}: convert it")
    corner = mask[:-1, :-1]
    even = np.bincount(corner[(corner == mask[1:, :-1]) & (corner == mask[:-1, 1:])], minlength=256)
    is_label = (counts >= MIN_AREA * mask.size) & (even >= 0.5 * counts)
    labels = is_label[1:NEARLY_WHITE].nonzero()[0] + 1
    if len(labels) > (3 if counts[255] else 1):  # 255 may stand for no label; few greys beside it are weights
        raise DataError(f"{path} has areas of {listed(labels)}, as images of labels have; {rule}: convert it")
    is_mark = len(values) == 1 and (values[0] == 1 or mask.min() == 0)  # else one weight for all
    return np.where(mask > 0, np.uint8(255), np.uint8(0)) if is_mark else mask


def _is_transparent(image: Image.Image) -> bool:
    """Return whether a pixel is not opaque, by an alpha channel, a palette with transparency, or a colour key."""
    key = image.info.get("transparency")
    if image.mode.startswith("I"):
        return key is not None and bool((np.asarray(image) == key).any())
    if image.mode not in _ALPHA and key is None:
        return False
    return np.asarray(image.convert("RGBA").getchannel("A")).min() < 255


def _eight_bit(image: Image.Image) -> Image.Image:
    """Scale 16-bit masks to 8 bits, which Pillow's own conversion would clip, and resolve transparent palettes."""
    if image.mode == "P" and "transparency" in image.info:
        return image.convert("RGBA")
    if not image.mode.startswith("I"):
        return image
    values = np.asarray(image).astype(np.int64)
    if values.max(initial=0) > 255:  # else it holds 8 bits
        values >>= 8
    return Image.fromarray(values.clip(0, 255).astype(np.uint8))


def read_bytes(path: Path, *, empty: bool = False) -> bytes:
    """Read a file, which may be `empty` if that is allowed; a DataError for no file, or a folder, pipe or device."""
    refuse_special(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise DataError(f"{path} does not exist") from error
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}); check its permissions") from error
    if data.startswith(b"version https://git-lfs"):
        raise DataError(f"{path} is a pointer of Git LFS, not the file; get it with `git lfs pull`")
    if not data and not empty:
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


def refuse_dual_fisheye(pixels: NDArray[np.uint8], path: Path) -> None:
    """Refuse pixels [H, 2H, 3] of an unstitched dual-fisheye camera: two circles on black."""
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
