"""Statements of an image file about its pixels: orientation, crop of a panorama, stereo, colours, pages.

They are read and applied, or the file is refused with a remedy; none is ignored. Pixels of a mask are no colours.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from typing import cast

import numpy as np
from PIL import ExifTags, Image, ImageCms

from padgs.data.capture import DataError
from padgs.files import DAMAGE

_SRGB_GAMMA = 0.45455  # of the gAMA chunk of a PNG
_SRGB_CHROMATICITIES = (0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06)  # white, red, green and blue of cHRM
_CROP_PROPERTIES = (
    *("FullPanoWidthPixels", "FullPanoHeightPixels", "CroppedAreaImageWidthPixels", "CroppedAreaImageHeightPixels"),
    *("CroppedAreaLeftPixels", "CroppedAreaTopPixels"),
)
_WIDEST = 100_000  # pixels
_SAME_COLOUR = 3  # of 255: profiles of sRGB differ in rounding
_REMOVE = "remove the metadata (`exiftool -all= FILE`) if they are wrong"
_TO_SRGB = "export the image as 8-bit sRGB, or convert it (`mogrify -colorspace sRGB -depth 8`)"
_STEREO = "it holds the views of two eyes: cut out the panorama of one eye"


@dataclass(frozen=True)
class Crop:
    """Position in pixels of a file's picture in its full panorama, of the size that the file has or is resized to."""

    left: int
    top: int
    width: int
    height: int
    full_width: int
    full_height: int


def _xmp(image: Image.Image) -> str:
    packet = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    if raw := image.info.get("Raw profile type xmp"):  # of ImageMagick, in hexadecimal after three lines
        packet = bytes.fromhex("".join((raw if isinstance(raw, str) else raw.decode("latin-1")).split("\n")[3:]))
    return packet if isinstance(packet, str) else packet.decode("utf-8", errors="replace").replace("\0", "")


def stated(xmp: str, name: str) -> str | None:
    """Return the value of a property, written as an attribute or as an element."""
    found = re.search(rf"""[:<]{name}\s*(?:=\s*["']([^"']*)["']|>([^<]*)<)""", xmp)
    return None if found is None else (found[1] if found[1] is not None else found[2]).strip()


def load_late_chunks(image: Image.Image, data: bytes) -> None:
    """Decode a PNG that has EXIF or XMP behind its pixels, which Pillow reads only then."""
    late = data[data.rfind(b"IDAT") :] if image.format == "PNG" else b""
    if any(name in late for name in (b"eXIf", b"com.adobe.xmp", b"Raw profile type")):
        image.load()


def refuse_rotated(image: Image.Image, path: object) -> None:
    """Refuse pixels that are stored rotated, by EXIF or XMP."""
    has_exif = image.format != "PNG" or {"exif", "Raw profile type exif"} & image.info.keys()
    try:
        by_exif = image.getexif().get(ExifTags.Base.Orientation) if has_exif else 1
    except DAMAGE as error:
        raise DataError(f"{path} has EXIF data that cannot be read ({error}); {_REMOVE}") from error
    for source, orientation in {"EXIF": by_exif, "XMP": stated(_xmp(image), "Orientation")}.items():
        if str(orientation) not in ("None", "0", "1"):
            raise DataError(
                f"{path} carries {source} orientation {orientation}: its pixels are stored rotated, and it is unknown "
                "which orientation the poses refer to: if to these pixels, as in COLMAP, remove the flag (`exiftool "
                "-Orientation= FILE`), else store it upright (`mogrify -auto-orient FILE`)"
            )


def refuse_several_pictures(image: Image.Image, path: object) -> None:
    """Refuse animations, several pages and stereo pairs. Previews and gain maps beside a picture are no pictures."""
    count = getattr(image, "n_frames", 1)
    if image.format == "MPO":
        kinds = {str(entry["Attribute"]["MPType"]) for entry in image.mpinfo.get(0xB002, ())}  # type: ignore[attr-defined]
        count = count if any("Multi-Frame" in kind for kind in kinds) else 1
    if count > 1:
        raise DataError(
            f"{path} holds {count} pictures (an animation, pages or a stereo pair); save the one that is meant as a "
            "file of its own (`magick 'FILE[0]' ONE.png`)"
        )
    mode = stated(_xmp(image), "StereoMode")
    if mode is not None and mode.casefold() not in ("", "mono", "none"):
        raise DataError(f"{path} says that it is stereo ({mode}): {_STEREO}, or {_REMOVE}")


def crop_of(image: Image.Image, path: object, within: Crop | None = None) -> Crop | None:
    """Return where the picture lies in its panorama (GPano); None if it is all; a DataError if numbers disagree.

    A mask that states nothing has the place of its image, `within`, if it has the size of the image's file.
    """
    xmp = _xmp(image)
    if (projection := stated(xmp, "ProjectionType") or "equirectangular").casefold() != "equirectangular":
        remedy = f"convert it with the program that made it, or {_REMOVE}"
        raise DataError(f"{path} says that its projection is {projection!r}, not equirectangular; {remedy}")
    texts = {name: stated(xmp, name) for name in _CROP_PROPERTIES}
    if all(text is None for text in texts.values()):
        is_same = within and max(abs(image.width - within.width), abs(image.height - within.height)) <= 1
        return within if is_same else None
    if all(text is None for name, text in texts.items() if "Full" not in name) and image.width == 2 * image.height:
        return None  # a whole panorama, resized
    said = ", ".join(f"{name} {text}" for name, text in texts.items() if text is not None)
    contradiction = f"{path} contradicts itself: it is {image.width}x{image.height} and says {said}; {_REMOVE}"
    usual = (image.width, image.height, image.width, image.height, 0, 0)
    try:
        full_width, full_height, width, height, left, top = (
            round(float(value if text is None else text)) for value, text in zip(usual, texts.values(), strict=True)
        )
    except (ValueError, OverflowError) as error:
        raise DataError(contradiction) from error
    if (image.width, image.height) == (full_width, full_height):
        return None  # filled up to the whole panorama since
    is_inside = min(left, top) >= 0 and left + width <= full_width <= _WIDEST and top + height <= full_height <= _WIDEST
    # Another program may have resized the picture, but not changed its proportions.
    if not is_inside or min(width, height) < 1 or abs(image.width * height / (image.height * width) - 1) > 0.02:
        raise DataError(contradiction)
    if (width, height) == (full_width, full_height):
        return None
    if full_width != 2 * full_height:
        rule = "which is not 2:1; correct FullPanoWidthPixels and FullPanoHeightPixels with exiftool"
        raise DataError(f"{path} says that it is a part of a panorama of {full_width}x{full_height}, {rule}")
    # The panorama of a resized picture is 2:1 too; to fit in whole pixels, the picture is stretched by one at most.
    rows = round(full_height * (image.width + image.height) / (width + height))
    left, top, right, bottom = (round(of * rows / full_height) for of in (left, top, left + width, top + height))
    return Crop(left, top, right - left, bottom - top, 2 * rows, rows)


def srgb_conversion(image: Image.Image, data: bytes, path: object) -> Callable[[Image.Image], Image.Image] | None:
    """Return the conversion of RGB pixels to sRGB by profile, gamma and colour space; None if they are sRGB."""
    header = data[: data.find(b"IDAT")] if image.format == "PNG" else b""
    if (place := header.find(b"cICP")) >= 0 and header[place + 4 : place + 8] != bytes((1, 13, 0, 1)):
        raise DataError(f"{path} has colours of video or HDR (cICP {[*header[place + 4 : place + 8]]}); {_TO_SRGB}")
    if profile := image.info.get("icc_profile"):
        try:
            return _icc_conversion(profile)
        except (ImageCms.PyCMSError, OSError, ImportError, ValueError, TypeError) as error:
            raise DataError(f"{path} has an ICC profile that cannot be applied ({error}); {_TO_SRGB}") from error
    exif = image.getexif() if image.format in ("JPEG", "MPO") else None
    if exif and exif.get_ifd(ExifTags.IFD.Interop).get(1) == "R03":
        raise DataError(f"{path} is in Adobe RGB by its EXIF data, without an ICC profile; {_TO_SRGB}")
    if "srgb" in image.info:
        return None
    chromaticities = image.info.get("chromaticity", _SRGB_CHROMATICITIES)
    if max(abs(a - b) for a, b in zip(chromaticities, _SRGB_CHROMATICITIES, strict=True)) > 0.01:
        raise DataError(f"{path} has primaries that are not those of sRGB (chunk cHRM); {_TO_SRGB}")
    gamma = image.info.get("gamma", _SRGB_GAMMA)
    if abs(gamma - _SRGB_GAMMA) < 0.02:
        return None
    if not 0.05 < gamma < 20:
        raise DataError(f"{path} has gamma {gamma:g} (chunk gAMA), which is unknown; {_TO_SRGB}")
    light = (np.arange(256) / 255) ** (1 / gamma)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    table = np.round(255 * encoded).astype(int).tolist()
    return lambda pixels: pixels.point(3 * table)


@lru_cache(maxsize=16)
def _icc_conversion(profile: bytes) -> Callable[[Image.Image], Image.Image] | None:
    """Return the conversion by an ICC profile of RGB colours; None if that is sRGB, by what it does to colours."""
    given, srgb = ImageCms.ImageCmsProfile(BytesIO(profile)), ImageCms.createProfile("sRGB")
    # The cache is not made for several threads.
    how = (ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.NOCACHE)
    transform = ImageCms.buildTransform(given, srgb, "RGB", "RGB", *how)
    steps = np.arange(0, 256, 15, dtype=np.uint8)
    colors = Image.fromarray(np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(1, -1, 3))
    converted = ImageCms.applyTransform(colors, transform)
    assert converted is not None
    if np.abs(np.asarray(converted).astype(int) - np.asarray(colors)).max() <= _SAME_COLOUR:
        return None
    return lambda pixels: cast(Image.Image, ImageCms.applyTransform(pixels, transform))
