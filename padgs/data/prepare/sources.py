"""Input of `prepare`: a folder of panoramas with masks, or a 360-degree video, checked before any work is done."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from padgs.data import images as image_files
from padgs.data.assemble import file_names, image_folder, image_names, refuse_clashes
from padgs.data.capture import Capture, DataError, Frame, Progress, listed
from padgs.data.check import OVERLAY
from padgs.data.images import EXTENSIONS, ImageFile, decode, inspect, refuse_dual_fisheye
from padgs.data.masks import SCENE_MASKS, Mask, find_masks, is_of_masks, mask_path
from padgs.data.scans import optional_module
from padgs.data.splits import check_name
from padgs.data.store import ImageStore

VIDEO_EXTENSIONS = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".wmv")
UNSTITCHED = (".insp", ".insv", ".osv", ".360", ".dng")  # raw files of 360-degree cameras
UNSUPPORTED = (".heic", ".heif", ".avif", ".jxl", ".jp2", ".hdr", ".exr")
_NOT_STITCHED = "is not stitched: export panoramas, or a 2:1 video, with the camera's own program"
_WAYS_OUT = (  # suffixes of unsupported files, and what to do with them
    (UNSTITCHED, _NOT_STITCHED),
    (UNSUPPORTED, "is an image in an unsupported format: convert all such images to JPEG"),
    (VIDEO_EXTENSIONS, "is a video: give its own path, not that of its folder"),
)
DECODED = 3  # images checked for dual fisheye; images of one camera are alike
MAX_DAMAGED, DAMAGED = 0.03, ".damaged"  # share of a video's packets that may be lost; hidden file with a note on them
_HDR_TRANSFER = {8: "linear", 16: "PQ", 18: "HLG"}  # numbers of ITU-T H.273
_UNTAGGED = 2  # number of H.273 for colours that the video does not state
_SD_HEIGHT = 576  # pixels; players take taller untagged videos as BT.709, FFmpeg's conversion all as BT.601
_ONE_PANORAMA = {  # of FFmpeg's metadata of frames: first numbers, and what to do with a video that has others
    "SPHERICAL": ((0,), "in another projection than equirectangular: convert it"),
    "STEREO3D": ((0,), "stereo: export one eye"),
    "DISPLAYMATRIX": ((65536, 0, 0, 0, 65536), "turned or mirrored: export it upright"),
}


def is_video(path: Path) -> bool:
    """Return whether a path has the suffix of a video."""
    return path.suffix.lower() in VIDEO_EXTENSIONS


def extract_frames(video: Path, folder: Path, per_second: float, progress: Progress = lambda done, total: None) -> int:
    """Write the sharpest frame of every 1 / per_second seconds of a stitched video as frame_00001.jpg, ...; count them.

    `progress` is called with (frames decoded, estimated total). A DataError says that the extra `video` is not
    installed, that more than `MAX_DAMAGED` of the file cannot be decoded, or that its frames are no panoramas.
    """
    seen, damaged = set[bytes](), list[bool]()
    for frame in _sharpest(video, per_second, progress, damaged):
        written = BytesIO()
        Image.fromarray(frame).save(written, "JPEG", quality=95, subsampling=0)
        digest = hashlib.sha256(written.getvalue()).digest()
        if digest in seen:  # of a still, or of a title that comes again
            continue
        seen.add(digest)
        (folder / f"frame_{len(seen):05d}.jpg").write_bytes(written.getvalue())
    if len(seen) < 2:
        what = f"{video} gives {len(seen)} different frames at {per_second:g} a second; poses need at least two"
        raise DataError(f"{what}: take more a second (`--per-second`), or a longer video")
    if lost := sum(damaged):
        note = f"{lost} of {len(damaged)} packets of {video} cannot be decoded"
        if lost > MAX_DAMAGED * len(damaged):
            raise DataError(f"{note}, and at most {MAX_DAMAGED:.0%} are left out: copy or export it again")
        (folder / DAMAGED).write_text(f"{note}, and are left out", encoding="utf-8")
    return len(seen)


def _sharpest(video: Path, per_second: float, progress: Progress, damaged: list[bool]) -> Iterator[NDArray[np.uint8]]:
    """Yield the sharpest frame [H, W, 3] of every interval of time that has a frame; `damaged` is of `_decoded`."""
    av = optional_module("av", video, "video")
    try:
        with av.open(str(video.absolute())) as container:  # a name may begin like a protocol
            if not container.streams.video:
                raise DataError(f"{video} holds no video stream; give a stitched 360-degree video")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            rate = float(stream.average_rate or 30)
            total = stream.frames or round(rate * float((container.duration or 0) / av.time_base))
            best, best_sharpness, interval, start = None, -1.0, 0, None
            for index, frame in enumerate(_decoded(container.demux(stream), av.error.InvalidDataError, damaged)):
                time = index / rate if frame.time is None else frame.time
                start = time if start is None else start
                if index == 0:  # before an hour of decoding
                    pixels = _pixels(frame, video)
                    image_files.refuse_other_shapes(pixels.shape[1], pixels.shape[0], video)
                    refuse_dual_fisheye(pixels, video)
                progress(index + 1, max(total, index + 1))
                now = int((time - start) * per_second + 1e-6)
                if best is not None and now != interval:
                    yield _pixels(best, video)
                    best, best_sharpness = None, -1.0
                if (sharp := sharpness(frame.to_ndarray(format="gray"))) > best_sharpness:
                    best, best_sharpness = frame, sharp
                interval = now
        if best is not None:
            yield _pixels(best, video)
    except DataError:  # not panoramas
        raise
    except (av.error.FFmpegError, OSError, ValueError, RuntimeError) as error:
        raise DataError(f"{video} cannot be decoded ({error}); convert it to H.264 in an .mp4 file") from error


def _decoded(packets: Iterable[Any], damage: type[Exception], damaged: list[bool]) -> Iterator[Any]:
    """Yield the frames of packets; `damaged` tells for each packet whether it is, and gives no frame."""
    for packet in packets:
        damaged.append(False)
        try:
            yield from packet.decode()
        except damage:
            damaged[-1] = True


def _pixels(frame: Any, video: Path) -> NDArray[np.uint8]:
    """Return the pixels of a frame; a DataError if they are not one upright panorama, or in colours of HDR."""
    if getattr(frame, "color_trc", None) in _HDR_TRANSFER:
        transfer = _HDR_TRANSFER[frame.color_trc]
        raise DataError(f"{video} is HDR (transfer {transfer}); export it in standard dynamic range")
    for side in frame.side_data:
        if side.type.name in _ONE_PANORAMA:
            numbers, otherwise = _ONE_PANORAMA[side.type.name]
            if tuple(np.frombuffer(bytes(side), np.int32, len(numbers)).tolist()) != numbers:
                raise DataError(f"{video} says that it is {otherwise}")
    is_hd = frame.height > _SD_HEIGHT and frame.colorspace == _UNTAGGED
    flags = optional_module("av", video, "video").video.reformatter.Interpolation
    exact = None  # older versions of PyAV know no flags; colours are then up to 2 of 255 too dark
    if hasattr(flags, "ACCURATE_RND"):
        exact = flags.BICUBIC | flags.ACCURATE_RND | flags.FULL_CHR_H_INT
    return frame.to_ndarray(format="rgb24", src_colorspace="ITU709" if is_hd else None, interpolation=exact)


def sharpness(frame: NDArray[np.uint8]) -> float:
    """Return the mean absolute Laplacian of a gray frame [H, W]; higher is sharper; comparable within one video."""
    gray = frame[::2, ::2].astype(np.int16)
    around = gray[:-2, 1:-1] + gray[2:, 1:-1] + gray[1:-1, :-2] + gray[1:-1, 2:]
    return float(np.abs(4 * gray[1:-1, 1:-1] - around).mean())


@dataclass(frozen=True)
class Source:
    """Panoramas without poses."""

    images: dict[str, ImageFile]  # name (path relative to the folder) -> file, sorted by name
    masks: dict[str, Mask]  # name -> weights; images without one are used entirely
    fingerprint: str  # of names, image bytes and masks
    notes: tuple[str, ...]  # about masks and ignored files


def find_source(path: Path, mask: str) -> Source:
    """Read and check a folder of panoramas, or one that holds them in images/.

    `mask` is as `data.mask`: auto searches for mask.png and masks/ beside the images and beside an images/ folder. A
    DataError names an unstitched file, fewer than two panoramas, unusable images, an unusable mask, two equal images,
    or names that differ only in case or extension.
    """
    if path.is_file() and path.suffix.lower() in UNSTITCHED:
        raise DataError(f"{path} {_NOT_STITCHED}")
    if not path.is_dir():
        raise DataError(f"{path} is not a folder; give a folder of panoramas, or a video file")
    given = mask_path(mask.removeprefix("inverted:"), path)
    every = panoramas(path, given)
    folder = path if any("/" not in name for name in every) else image_folder(path, None)
    names = [check_name(name, str(folder)) for name in panoramas(folder, given)]
    others, ways_out = _others(folder)
    if len(names) < 2:
        found = f"{folder} holds {len(names)} images{f' (left out: {others})' if others else ''}"
        raise DataError(f"{found}; structure from motion needs at least two{ways_out}")
    refuse_clashes(names)
    images, bad = dict[str, ImageFile](), list[str]()
    for name in names:
        try:
            images[name] = inspect(folder / name)
        except DataError as error:
            bad.append(str(error))
    if bad:
        raise DataError(listed(bad, most=3))
    for name in names[:: -(-len(names) // DECODED)]:
        refuse_dual_fisheye(decode(folder / name), folder / name)
    by_digest = {image.digest: name for name, image in images.items()}
    if twins := [f"{name} and {by_digest[of.digest]}" for name, of in images.items() if by_digest[of.digest] != name]:
        raise DataError(f"{folder} holds images that are the same: {listed(twins)}; remove one of each pair")
    no_pose = torch.eye(4, dtype=torch.float64)
    frames = tuple(Frame(name, image.path, no_pose, image.width, image.height) for name, image in images.items())
    capture = Capture("images", folder, folder, frames, cloud=None)
    sizes = [(image.width, image.height) for image in images.values()]
    masks, digests, mask_notes = find_masks(capture, mask, list(images.values()), sizes, ImageStore())
    notes = [*image_files.notes_on(list(images.values())), *mask_notes]
    if others:
        notes.append(f"left out: {others}{ways_out}")
    if beside := [name for name in every if not (path / name).is_relative_to(folder)]:  # such as reduced copies
        notes.append(f"{len(beside)} images beside {folder.name}/ are not used: {listed(beside)}")
    read = {found.file.path for found in masks if found is not None and found.file is not None}
    unused = [name for name in image_names(folder) if name not in images and folder / name not in read]
    if mask == "auto" and (unused := [name for name in unused if PurePosixPath(name).name.lower() != OVERLAY]):
        rule = f"a mask of all panoramas must be in {capture.places[0]}, others in masks/ with their names"
        notes.append(f"not used: {listed(unused)}; {rule}")
    identity = "".join(f"{name}|{image.digest}|" for name, image in images.items()) + repr(digests)
    used = {name: found for name, found in zip(names, masks, strict=True) if found is not None}
    return Source(images, used, hashlib.sha256(identity.encode()).hexdigest(), tuple(notes))


def panoramas(folder: Path, masks: Path | None = None) -> list[str]:
    """Return the panoramas below a folder, relative to it and sorted, without masks; `masks` has some of them."""
    others, root, place = (*SCENE_MASKS, OVERLAY), folder.resolve(), masks and masks.resolve()
    inner = place.relative_to(root).as_posix() if place and root in place.parents else ""
    names = [name for name in image_names(folder) if not is_of_masks(name)]
    names = [name for name in names if not (inner and PurePosixPath(name).is_relative_to(inner))]
    return [name for name in names if PurePosixPath(name).name.lower() not in others]


def _others(folder: Path) -> tuple[str, str]:
    """Count the files that are not images by suffix, and say what to do with them; both empty if there are none."""
    names = [name for name in file_names(folder) if not name.lower().endswith(EXTENSIONS)]
    counts = Counter(PurePosixPath(name).suffix.lower() or "without a suffix" for name in names)
    firsts = [(next((name for name in names if name.lower().endswith(kinds)), None), way) for kinds, way in _WAYS_OUT]
    ways_out = "".join(f"; {name} {way}" for name, way in firsts if name)
    return listed(f"{count} {suffix}" for suffix, count in counts.most_common()), ways_out
