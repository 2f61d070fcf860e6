"""A mask over what stands below the camera, tripod or photographer, for all panoramas of a folder."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

import padgs.data
from padgs.data.assemble import image_folder
from padgs.data.capture import DataError, listed
from padgs.data.images import decode, inspect, save_png
from padgs.data.masks import PREVIEW, SCENE_MASKS, row_weights
from padgs.data.prepare.sources import mask_folder, panoramas

WIDTH = 1024  # of the preview at most
RED = (220, 30, 30)  # half of which covers what is hidden


class NadirMask(NamedTuple):
    """What was written."""

    mask: Path
    preview: Path  # the first panorama, with what is hidden in red
    images: int  # that it is for


def write_nadir_mask(path: Path, below: float, *, overwrite: bool = False) -> NadirMask:
    """Write mask.png, which hides all that is further below the horizon of the camera, and a preview.

    Args:
        path: folder of panoramas, or of a data set; the mask goes where reading it looks for one.
        below: degrees.
        overwrite: replace a mask that is there.

    Raises:
        DataError: no such angle, no panoramas or of several sizes, or there are masks already.
    """
    if not 0 < below < 90:
        raise DataError(f"{below:g} degrees below the horizon hide nothing, or half of all; give more than 0, up to 89")
    if not path.is_dir():
        raise DataError(f"{path} is not a folder; give a folder of panoramas, or of a data set")
    images, place = image_folder(path, None), mask_folder(path)
    names = panoramas(images)
    if not names:
        raise DataError(f"{images} holds no images; give a folder of panoramas, or of a data set")
    if not overwrite and (found := next((place / name for name in SCENE_MASKS if (place / name).exists()), None)):
        raise DataError(f"{found} exists; look at it, and say --overwrite to replace it")
    _refuse_other_masks(place)
    files = [inspect(images / name) for name in names]
    sizes = sorted({(file.width, file.height) for file in files})
    if len(sizes) > 1:
        found = listed(f"{width}x{height}" for width, height in sizes)
        raise DataError(
            f"the panoramas have {len(sizes)} sizes ({found}), and a mask has that of its image: resize them"
        )
    width, height = sizes[0]
    use = row_weights(90 + below, 180, height)
    hidden = 1 - use.numpy()[..., None]
    picture = decode(files[0].path) * (1 - hidden / 2) + hidden / 2 * np.array(RED)
    preview = Image.fromarray(picture.round().astype(np.uint8))
    preview.thumbnail((WIDTH, WIDTH // 2))
    try:
        save_png(255 * use.expand(-1, width), place / SCENE_MASKS[0])
        preview.save(place / PREVIEW)
    except OSError as error:
        raise DataError(f"cannot write into {place} ({error.strerror or error}); mend its permissions") from error
    return NadirMask(place / SCENE_MASKS[0], place / PREVIEW, len(files))


def _refuse_other_masks(folder: Path) -> None:
    """Refuse a folder with masks of single images: they would not be read beside mask.png, or it beside them."""
    if (folder / "masks").is_dir():
        raise DataError(
            f"{folder / 'masks'} holds masks of single images, which mask.png would put out of use; hide what is below "
            "the camera in those, or give that folder another name"
        )
    try:
        capture = padgs.data.read(folder)
    except DataError:  # panoramas alone: nothing names their masks
        return
    named = next((frame.mask for frame in capture.frames if frame.mask is not None), None)
    if named is not None:
        raise DataError(
            f"{capture.format} names masks of its own, such as {named}, beside which mask.png would not be read; hide "
            f"what is below the camera in those, or take them out of {folder} and of what describes it"
        )
