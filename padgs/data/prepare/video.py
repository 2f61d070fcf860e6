"""Frames of a 360-degree video: the sharpest of every interval, as JPEG files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from padgs.data.errors import DataError
from padgs.data.fisheye import refuse_dual_fisheye
from padgs.data.images import refuse_other_shapes

EXTENSIONS = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")


def is_video(path: Path) -> bool:
    """Whether a path is taken for a video, by its name."""
    return path.suffix.lower() in EXTENSIONS


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
