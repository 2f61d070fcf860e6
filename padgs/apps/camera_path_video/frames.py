"""Where the frames of a film go: a folder of PNGs, or an .mp4 (H.264); colours, and depth beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image
from torch import Tensor

from padgs.apps.camera_path_video.spherical import mark_spherical
from padgs.evaluation.pictures import depth_picture, eight_bit
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
            puts[0](eight_bit(rendering.image))
            if depth:
                puts[1](depth_picture(rendering, unit) if film else _sixteen_bit(rendering.depth / unit))
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
