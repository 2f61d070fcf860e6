"""Sources."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from padgs.data.assemble import file_names, image_folder, image_names, refuse_clashes
from padgs.data.capture import Capture, DataError, Frame, listed
from padgs.data.check import OVERLAY
from padgs.data.images import EXTENSIONS, ImageFile, decode, inspect, refuse_dual_fisheye, refuse_other_shapes
from padgs.data.masks import PREVIEW, SCENE_MASKS, Mask, find_masks
from padgs.data.store import ImageStore

VIDEO_EXTENSIONS = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")


def is_video(path: Path) -> bool:
    """Whether a path is taken for a video, by its name."""
    return path.suffix.lower() in VIDEO_EXTENSIONS


def extract_frames(
    video: Path, folder: Path, per_second: float, progress: Callable[[int, int], None] = lambda done, total: None
) -> int:
    """Write the sharpest frame of every 1 / per_second seconds to `folder` as frame_00001.jpg, ...

    Args:
        video: a stitched (equirectangular) video.
        folder: exists; files there are overwritten.
        per_second: frames kept per second of video.
        progress: called with (frames decoded, frames in all as far as is known).

    Returns:
        Number of frames written.

    Raises:
        DataError: the extra `video` is not installed, the file cannot be decoded, or its frames are no panoramas.
        OSError: a frame cannot be written.
    """
    written = 0
    for frame in _sharpest(video, per_second, progress):
        written += 1
        Image.fromarray(frame).save(folder / f"frame_{written:05d}.jpg", quality=95, subsampling=0)
    if written == 0:
        raise DataError(f"{video} holds no frames")
    return written


def _sharpest(video: Path, per_second: float, progress: Callable[[int, int], None]) -> Iterator[NDArray[np.uint8]]:
    """The sharpest frame [H, W, 3] of every interval. What their user raises is not taken for an error of decoding."""
    try:
        import imageio.v3 as imageio

        meta = imageio.immeta(video, plugin="pyav")
        rate = float(meta.get("fps") or 30.0)
        total = round(rate * float(meta.get("duration") or 0.0))
        interval = max(1, round(rate / per_second))

        def frames() -> Iterator[NDArray[np.uint8]]:
            for index, frame in enumerate(imageio.imiter(video, plugin="pyav")):
                if index == 0:  # an hour of decoding would tell no more
                    refuse_other_shapes(frame.shape[1], frame.shape[0], video)
                    refuse_dual_fisheye(frame, video)
                progress(index + 1, max(total, index + 1))
                yield frame

        decoded = frames()
        while (best := max(islice(decoded, interval), key=sharpness, default=None)) is not None:
            yield best
    except ImportError as error:
        raise DataError(f"reading {video} needs imageio and PyAV: pip install 'padgs[video]'") from error
    except DataError:  # no panoramas
        raise
    except (OSError, ValueError, RuntimeError, StopIteration) as error:
        raise DataError(f"{video} cannot be decoded ({error}); convert it to H.264 in an .mp4 file") from error


def sharpness(frame: NDArray[np.uint8]) -> float:
    """Mean strength of the Laplacian of a frame [H, W, 3]; higher is sharper. Comparable within one video only.

    >>> sharpness(np.full((8, 16, 3), 7, np.uint8))
    0.0
    """
    gray = frame[::2, ::2, 1].astype(np.int16)
    return float(
        np.abs(4 * gray[1:-1, 1:-1] - gray[:-2, 1:-1] - gray[2:, 1:-1] - gray[1:-1, :-2] - gray[1:-1, 2:]).mean()
    )


UNSTITCHED = (".insp", ".insv", ".360", ".dng")  # what cameras store before their own program has stitched it
UNREAD = (".heic", ".heif", ".avif", ".jxl", ".jp2", ".hdr", ".exr")
_NOT_YET = "is not stitched yet: export panoramas, or a 2:1 video, with the camera's own program"
_WAYS_OUT = (  # endings of files that are no images here, and what to do with them
    (UNSTITCHED, _NOT_YET),
    (UNREAD, "is a picture of a kind that is not read here: convert all such pictures to JPEG"),
    (VIDEO_EXTENSIONS, "is a video: give its own path, not that of its folder"),
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
