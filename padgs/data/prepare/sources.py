"""What `prepare` starts from: a folder of panoramas with their masks, looked at before any work is done."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import torch

from padgs.data.assemble import file_names, image_folder, image_names, refuse_clashes
from padgs.data.capture import Capture, Frame
from padgs.data.check.overlay import OVERLAY
from padgs.data.errors import DataError, listed
from padgs.data.fisheye import refuse_dual_fisheye
from padgs.data.images import EXTENSIONS, ImageFile, decode, inspect
from padgs.data.masks import PREVIEW, SCENE_MASKS, Mask, find_masks
from padgs.data.prepare import video
from padgs.data.store import ImageStore

UNSTITCHED = (".insp", ".insv", ".360", ".dng")  # what cameras store before their own program has stitched it
UNREAD = (".heic", ".heif", ".avif", ".jxl", ".jp2", ".hdr", ".exr")
_NOT_YET = "is not stitched yet: export panoramas, or a 2:1 video, with the camera's own program"
_WAYS_OUT = (  # endings of files that are no images here, and what to do with them
    (UNSTITCHED, _NOT_YET),
    (UNREAD, "is a picture of a kind that is not read here: convert all such pictures to JPEG"),
    (video.EXTENSIONS, "is a video: give its own path, not that of its folder"),
)
LOOKED_AT = 3  # images that are decoded before any work is done; those of one camera are alike


@dataclass(frozen=True)
class Source:
    """Panoramas without poses."""

    images: dict[str, ImageFile]  # name (path relative to the folder) -> file, sorted by name
    masks: dict[str, Mask]  # name -> weights; names without one are used wholly
    fingerprint: str  # of names, image bytes and masks
    notes: tuple[str, ...]  # of masks, and of files that are left out


def find_source(path: Path, mask: str) -> Source:
    """Look through a folder of panoramas.

    Args:
        path: the folder, or one that holds them in images/.
        mask: as `data.mask`: auto | none | rows:959/1024 | a file, or a folder of files. auto looks for mask.png and
            masks/ beside the images and beside an images/ folder.

    Raises:
        DataError: no folder, a file that is not stitched yet, fewer than two panoramas, an image that cannot be used,
            names that differ only in case or extension, a mask that does not fit.
    """
    if path.is_file() and path.suffix.lower() in UNSTITCHED:
        raise DataError(f"{path} {_NOT_YET}")
    if not path.is_dir():
        raise DataError(f"{path} is not a folder; give a folder of panoramas, or a video file")
    folder = image_folder(path, None)
    names = panoramas(folder)
    others, ways_out = _others(folder)
    if len(names) < 2:
        besides = f" (left out: {others})" if others else ""
        raise DataError(
            f"{folder} holds {len(names)} images{besides}; structure from motion needs at least two{ways_out}"
        )
    refuse_clashes(names)
    images = {name: inspect(folder / name) for name in names}
    for name in names[:: -(-len(names) // LOOKED_AT)]:
        refuse_dual_fisheye(decode(folder / name), folder / name)
    nowhere = torch.eye(4, dtype=torch.float64)
    frames = tuple(Frame(name, image.path, nowhere, image.width, image.height) for name, image in images.items())
    capture = Capture(format="images", folder=mask_folder(path), image_folder=folder, frames=frames, cloud=None)
    sizes = [(image.width, image.height) for image in images.values()]
    masks, digests, notes = find_masks(capture, mask, list(images.values()), sizes, ImageStore())
    if others:
        notes.append(f"left out: {others}{ways_out}")
    place = mask_folder(path)
    if unused := [name for name in _scene_masks(folder) if mask == "auto" and (folder / name).parent != place]:
        notes.append(f"not used: {listed(unused)}; the mask of all panoramas is looked for in {place} alone")
    digest = hashlib.sha256()
    for name, image in images.items():
        digest.update(f"{name}|{image.digest}|".encode())
    digest.update(repr(digests).encode())
    return Source(
        images=images,
        masks={name: found for name, found in zip(names, masks, strict=True) if found is not None},
        fingerprint=digest.hexdigest(),
        notes=tuple(notes),
    )


def panoramas(folder: Path) -> list[str]:
    """The images below a folder, relative to it, sorted, without the masks and pictures of ours among them."""
    others = (*SCENE_MASKS, PREVIEW, OVERLAY)
    names = [name for name in image_names(folder) if not name.startswith("masks/")]
    return [name for name in names if PurePosixPath(name).name not in others]


def _scene_masks(folder: Path) -> list[str]:
    return [name for name in image_names(folder) if PurePosixPath(name).name in SCENE_MASKS]


def _others(folder: Path) -> tuple[str, str]:
    """How many files of which endings are no images, and what to do with them; both empty if there are none."""
    names = [name for name in file_names(folder) if not name.lower().endswith(EXTENSIONS)]
    counts = Counter(PurePosixPath(name).suffix.lower() or "without an ending" for name in names)
    firsts = [(next((name for name in names if name.lower().endswith(kinds)), None), way) for kinds, way in _WAYS_OUT]
    ways_out = "".join(f"; {name} {way}" for name, way in firsts if name)
    return listed(f"{count} {ending}" for ending, count in counts.most_common()), ways_out


def mask_folder(path: Path) -> Path:
    """Where masks of a folder of panoramas are looked for: there, or beside it if it is called images."""
    return path.parent if path.name == "images" and image_folder(path, None) == path else path
