"""Input of `prepare`: a folder of panoramas with masks, or a 360-degree video, checked before any work is done."""

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
from padgs.data.images import (
    EXTENSIONS,
    ImageFile,
    decode,
    inspect,
    notes_on,
    refuse_dual_fisheye,
    refuse_other_shapes,
)
from padgs.data.masks import PREVIEW, SCENE_MASKS, Mask, find_masks
from padgs.data.store import ImageStore

VIDEO_EXTENSIONS = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")


def is_video(path: Path) -> bool:
    """Return whether a path has the suffix of a video."""
    return path.suffix.lower() in VIDEO_EXTENSIONS


def extract_frames(
    video: Path, folder: Path, per_second: float, progress: Callable[[int, int], None] = lambda done, total: None
) -> int:
    """Write the sharpest frame of every 1 / per_second seconds of a stitched video as frame_00001.jpg, ...

    `progress` is called with (frames decoded, estimated total).

    Returns:
        Number of frames written.

    Raises:
        DataError: the extra `video` is not installed, the file cannot be decoded, or its frames are not panoramas.
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
    """Yield the sharpest frame [H, W, 3] of every interval."""
    try:
        import imageio.v3 as imageio

        meta = imageio.immeta(video, plugin="pyav")
        rate = float(meta.get("fps") or 30.0)
        total = round(rate * float(meta.get("duration") or 0.0))
        interval = max(1, round(rate / per_second))

        def frames() -> Iterator[NDArray[np.uint8]]:
            for index, frame in enumerate(imageio.imiter(video, plugin="pyav")):
                if index == 0:  # before an hour of decoding
                    refuse_other_shapes(frame.shape[1], frame.shape[0], video)
                    refuse_dual_fisheye(frame, video)
                progress(index + 1, max(total, index + 1))
                yield frame

        decoded = frames()
        while (best := max(islice(decoded, interval), key=sharpness, default=None)) is not None:
            yield best
    except ImportError as error:
        raise DataError(f"reading {video} needs imageio and PyAV: pip install 'padgs[video]'") from error
    except DataError:  # not panoramas
        raise
    except (OSError, ValueError, RuntimeError, StopIteration) as error:
        raise DataError(f"{video} cannot be decoded ({error}); convert it to H.264 in an .mp4 file") from error


def sharpness(frame: NDArray[np.uint8]) -> float:
    """Return the mean absolute Laplacian of a frame [H, W, 3]; higher is sharper. Comparable within one video only.

    >>> sharpness(np.full((8, 16, 3), 7, np.uint8))
    0.0
    """
    gray = frame[::2, ::2, 1].astype(np.int16)
    return float(
        np.abs(4 * gray[1:-1, 1:-1] - gray[:-2, 1:-1] - gray[2:, 1:-1] - gray[1:-1, :-2] - gray[1:-1, 2:]).mean()
    )


UNSTITCHED = (".insp", ".insv", ".360", ".dng")  # raw files of 360-degree cameras
UNSUPPORTED = (".heic", ".heif", ".avif", ".jxl", ".jp2", ".hdr", ".exr")
_NOT_STITCHED = "is not stitched: export panoramas, or a 2:1 video, with the camera's own program"
_WAYS_OUT = (  # suffixes of unsupported files, and what to do with them
    (UNSTITCHED, _NOT_STITCHED),
    (UNSUPPORTED, "is an image in an unsupported format: convert all such images to JPEG"),
    (VIDEO_EXTENSIONS, "is a video: give its own path, not that of its folder"),
)
DECODED = 3  # images checked for dual fisheye; images of one camera are alike


@dataclass(frozen=True)
class Source:
    """Panoramas without poses."""

    images: dict[str, ImageFile]  # name (path relative to the folder) -> file, sorted by name
    masks: dict[str, Mask]  # name -> weights; images without one are used entirely
    fingerprint: str  # of names, image bytes and masks
    notes: tuple[str, ...]  # about masks and ignored files


def find_source(path: Path, mask: str) -> Source:
    """Read and check a folder of panoramas, or one that holds them in images/.

    `mask` is as `data.mask`: auto searches for mask.png and masks/ beside the images and beside an images/ folder.

    Raises:
        DataError: no folder, an unstitched file, fewer than two panoramas, an unusable image, names that differ only in
            case or extension, or an unusable mask.
    """
    if path.is_file() and path.suffix.lower() in UNSTITCHED:
        raise DataError(f"{path} {_NOT_STITCHED}")
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
    for name in names[:: -(-len(names) // DECODED)]:
        refuse_dual_fisheye(decode(folder / name), folder / name)
    no_pose = torch.eye(4, dtype=torch.float64)
    frames = tuple(Frame(name, image.path, no_pose, image.width, image.height) for name, image in images.items())
    capture = Capture(format="images", folder=mask_folder(path), image_folder=folder, frames=frames, cloud=None)
    sizes = [(image.width, image.height) for image in images.values()]
    masks, digests, mask_notes = find_masks(capture, mask, list(images.values()), sizes, ImageStore())
    notes = [*notes_on(list(images.values())), *mask_notes]
    if others:
        notes.append(f"left out: {others}{ways_out}")
    expected = mask_folder(path)
    if unused := [name for name in _scene_masks(folder) if mask == "auto" and (folder / name).parent != expected]:
        notes.append(f"not used: {listed(unused)}; a mask of all panoramas must be in {expected}")
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
    """Return the panoramas below a folder, relative to it and sorted, without masks and previews."""
    others = (*SCENE_MASKS, PREVIEW, OVERLAY)
    names = [name for name in image_names(folder) if not name.startswith("masks/")]
    return [name for name in names if PurePosixPath(name).name not in others]


def _scene_masks(folder: Path) -> list[str]:
    return [name for name in image_names(folder) if PurePosixPath(name).name in SCENE_MASKS]


def _others(folder: Path) -> tuple[str, str]:
    """Count the files that are not images by suffix, and say what to do with them; both empty if there are none."""
    names = [name for name in file_names(folder) if not name.lower().endswith(EXTENSIONS)]
    counts = Counter(PurePosixPath(name).suffix.lower() or "without a suffix" for name in names)
    firsts = [(next((name for name in names if name.lower().endswith(kinds)), None), way) for kinds, way in _WAYS_OUT]
    ways_out = "".join(f"; {name} {way}" for name, way in firsts if name)
    return listed(f"{count} {suffix}" for suffix, count in counts.most_common()), ways_out


def mask_folder(path: Path) -> Path:
    """Return the folder that is searched for masks: that of the panoramas, or its parent if it is called images."""
    return path.parent if path.name == "images" and image_folder(path, None) == path else path
