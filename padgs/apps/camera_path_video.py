"""Camera-path videos: an .mp4 (H.264) or a folder of PNGs, in colour, with depth beside it."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory
from uuid import UUID

import numpy as np
from PIL import Image
from torch import Tensor

from padgs.evaluation.images import depth_image, to_uint8
from padgs.extras import installing
from padgs.render import Rendering
from padgs.replacing import replacing
from padgs.scene import View

Put = Callable[[np.ndarray], None]  # takes the next frame, [H, W, 3] uint8
DEPTH_STEPS = 1000  # of a 16-bit depth picture, in the unit of the scene
# What an .mp4 holds and says so: players that are not told take large films to be BT.709, small ones to be BT.601.
COLOURS = {"colorspace": "bt709", "color_primaries": "bt709", "color_trc": "bt709", "color_range": "tv"}


def write_film(
    to: Path,
    views: Sequence[View],
    draw: Callable[[View], Rendering],
    *,
    fps: float,
    unit: float,
    depth: bool = False,
    spherical: bool = False,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Path]:
    """Draw the views and write them, in order.

    Args:
        to: *.mp4, or a folder for PNGs, where they appear once all are drawn. A film that is there is replaced once the
            new one is complete.
        views, draw: what is drawn, and who does it.
        fps: frames per second of an .mp4.
        unit: of the scene, which depths are shown and stored in.
        depth: write depth too: for films one of colours, bright is near; for PNGs 16 bits, `DEPTH_STEPS` to a unit.
        spherical: the views are panoramas, and players of an .mp4 shall know.
        progress: called with the number of frames that are done.

    Returns:
        What was written: films, or folders.

    Raises:
        ValueError: a file of another kind, the extra `video` is not installed, or sides that H.264 does not take.
        OSError: it cannot be written.
    """
    film = to.suffix.lower() == ".mp4"
    if to.suffix and not film and not to.is_dir():
        raise ValueError(f"{to} is no .mp4, and films are written as nothing else; a folder for PNGs has no ending")
    places = [to, to.with_name(f"{to.stem}-depth{to.suffix}")] if depth else [to]
    with ExitStack() as stack:
        if film:
            puts = [stack.enter_context(_film(place, views[0], fps, spherical)) for place in places]
        else:
            puts = [stack.enter_context(_folder(place)) for place in places]
        for number, view in enumerate(views):
            rendering = draw(view)
            puts[0](to_uint8(rendering.image))
            if depth:
                puts[1](depth_image(rendering, unit) if film else _sixteen_bit(rendering.depth / unit))
            progress(number + 1)
    return places


def _sixteen_bit(depth: Tensor) -> np.ndarray:
    return (depth * DEPTH_STEPS).round().clamp(0, 2**16 - 1).cpu().numpy().astype(np.uint16)


@contextmanager
def _folder(place: Path) -> Iterator[Put]:
    place.mkdir(parents=True, exist_ok=True)
    if stale := next(place.glob("*.png"), None):
        raise ValueError(f"{place} holds pictures already, such as {stale.name}; name another folder with --to")
    numbers = iter(range(1, 1 << 30))
    with TemporaryDirectory(prefix=".", dir=place) as draft:  # pictures of a film that is cut off would bar the next

        def put(frame: np.ndarray) -> None:
            Image.fromarray(frame).save(Path(draft) / f"{next(numbers):05d}.png")

        yield put
        for picture in sorted(Path(draft).iterdir()):
            picture.replace(place / picture.name)


@contextmanager
def _film(place: Path, view: View, fps: float, spherical: bool) -> Iterator[Put]:
    if view.width % 2 or view.height % 2:
        raise ValueError(f"frames are {view.width}x{view.height}; H.264 takes even sides only, or name a folder")
    try:
        import av
    except ImportError as error:
        raise ValueError(f"writing {place} needs PyAV: {installing('video')}; a folder for PNGs does not") from error
    place.parent.mkdir(parents=True, exist_ok=True)
    with replacing(place) as draft:
        with av.open(str(draft), "w") as film:
            options = {"crf": "18", **COLOURS}
            stream = film.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000), options=options)
            stream.width, stream.height, stream.pix_fmt = view.width, view.height, "yuv420p"

            def put(frame: np.ndarray) -> None:
                picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
                film.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace="ITU709")))

            yield put
            film.mux(stream.encode())  # what the encoder still holds back
        if spherical:
            mark_spherical(draft)


SPHERICAL = UUID("ffcc8263-f855-4a93-8814-587a02521fdd").bytes
XML = (
    '<?xml version="1.0"?><rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
    'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/"><GSpherical:Spherical>true</GSpherical:Spherical>'
    "<GSpherical:Stitched>true</GSpherical:Stitched><GSpherical:ProjectionType>equirectangular</GSpherical:"
    "ProjectionType><GSpherical:StitchingSoftware>padgs</GSpherical:StitchingSoftware></rdf:SphericalVideo>"
)


def mark_spherical(film: Path) -> None:
    """Mark an .mp4 of one track as an equirectangular panorama, in place.

    Raises:
        ValueError: its last box is not the index, or the index has no track.
    """
    with film.open("r+b") as file:
        found = (b"", 0, 0)
        end = file.seek(0, 2)
        start = 0
        while start < end:
            file.seek(start)
            size, kind = struct.unpack(">I4s", file.read(8))
            if size == 1:  # 64 bits of it follow
                (size,) = struct.unpack(">Q", file.read(8))
            found, start = (kind, start, size), start + (size or end - start)
        kind, start, size = found
        if kind != b"moov":
            raise ValueError(f"{film} ends with a box {kind.decode('latin1')!r}; it must be the index, moov")
        file.seek(start)
        index = file.read(size)
        file.seek(start)
        file.write(_with_box(index))


def _with_box(index: bytes) -> bytes:
    """The index with the box at the end of its first track."""
    position = 8
    while position < len(index):
        size, kind = struct.unpack_from(">I4s", index, position)
        if kind == b"trak":
            content = SPHERICAL + XML.encode()
            box = struct.pack(">I4s", 8 + len(content), b"uuid") + content
            track = struct.pack(">I", size + len(box)) + index[position + 4 : position + size] + box
            whole = index[4:position] + track + index[position + size :]
            return struct.pack(">I", len(whole) + 4) + whole
        position += size
    raise ValueError("the film has no track")
