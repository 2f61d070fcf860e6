"""Nadir masks: hide tripod and photographer below the camera in all panoramas of a folder."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

import padgs.data
from padgs.data.assemble import image_folder
from padgs.data.capture import DataError, listed
from padgs.data.images import decode, inspect, save_png
from padgs.data.masks import MASK_FOLDERS, PREVIEW, SCENE_MASKS, row_weights
from padgs.data.prepare.sources import mask_folder, panoramas
from padgs.files import atomic_path

MAX_WIDTH = 1024  # of the preview
RED = (220, 30, 30)  # blended into masked pixels by half


class NadirMask(NamedTuple):
    """Written files."""

    mask: Path
    preview: Path  # the first panorama, masked pixels in red
    images: int  # number of masked panoramas


def write_nadir_mask(path: Path, below: float, *, overwrite: bool = False) -> NadirMask:
    """Write mask.png, which hides everything more than `below` degrees under the horizon, and a preview.

    Readers find the mask in `path`, a folder of panoramas or of a data set.

    Raises:
        DataError: invalid angle, no panoramas or several sizes, or other masks exist.
    """
    if not 0 < below < 90:
        raise DataError(
            f"{below:g} degrees below the horizon hides nothing, or half of the image; give more than 0, up to 89"
        )
    if not path.is_dir():
        raise DataError(f"{path} is not a folder; give a folder of panoramas, or of a data set")
    images, target = image_folder(path, None), mask_folder(path)
    names = panoramas(images)
    if not names:
        raise DataError(f"{images} holds no images; give a folder of panoramas, or of a data set")
    if not overwrite and (found := next((target / name for name in SCENE_MASKS if (target / name).exists()), None)):
        raise DataError(f"{found} exists; check it, and use --overwrite to replace it")
    _refuse_other_masks(target)
    files = [inspect(images / name) for name in names]
    sizes = sorted({(file.width, file.height) for file in files})
    if len(sizes) > 1:
        found = listed(f"{width}x{height}" for width, height in sizes)
        raise DataError(
            f"the panoramas have {len(sizes)} sizes ({found}), and a mask must have the size of its image: resize them"
        )
    width, height = sizes[0]
    use = row_weights(90 + below, 180, height)
    hidden = 1 - use.numpy()[..., None]
    image = decode(files[0].path) * (1 - hidden / 2) + hidden / 2 * np.array(RED)
    preview = Image.fromarray(image.round().astype(np.uint8))
    preview.thumbnail((MAX_WIDTH, MAX_WIDTH // 2))
    try:
        with atomic_path(target / SCENE_MASKS[0]) as draft:  # half a mask would be taken for one
            save_png(255 * use.expand(-1, width), draft)
        preview.save(target / PREVIEW)
    except OSError as error:
        raise DataError(f"cannot write into {target} ({error.strerror or error}); check its permissions") from error
    return NadirMask(target / SCENE_MASKS[0], target / PREVIEW, len(files))


def _refuse_other_masks(folder: Path) -> None:
    """Refuse a folder with per-image masks, of which only one kind would be read."""
    if found := next((folder / name for name in MASK_FOLDERS if (folder / name).is_dir()), None):
        raise DataError(
            f"{found} holds masks of single images, which mask.png would replace; mask the nadir in those "
            "files, or rename that folder"
        )
    try:
        capture = padgs.data.read(folder)
    except DataError:  # panoramas without a model, which could name masks
        return
    named = next((frame.mask for frame in capture.frames if frame.mask is not None), None)
    if named is not None:
        raise DataError(
            f"{capture.format} names masks of its own, such as {named}, which take precedence over mask.png; mask the "
            f"nadir in those files, or remove them from {folder} and from the file that names them"
        )
