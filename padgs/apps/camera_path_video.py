"""Camera-path videos: an .mp4 (H.264) or a folder of PNGs, of colours and optionally depth.

Panoramic .mp4 files carry Google's Spherical Video V1 metadata: a box of XML in the video track. An .mp4 is a tree of
boxes, each 4 bytes of size, 4 of type, and content. Appending to the track moves no data that is addressed by position,
because the index (`moov`) is the last box.
"""

import json
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from fractions import Fraction
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO
from uuid import UUID

import numpy as np
import torch
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from torch import Tensor

from padgs.checks import install_command
from padgs.data.camera_paths import PATHS, gravity
from padgs.data.capture import DataError
from padgs.data.depths import STATEMENT
from padgs.data.formats.path_file import read_path
from padgs.data.formats.transforms import transforms_file
from padgs.evaluation.images import depth_image, to_uint8
from padgs.files import atomic_path, draft_of, write_atomically
from padgs.geometry.camera import Camera, Panorama, Pinhole, perspective
from padgs.render import Rendering
from padgs.runs.load import LoadedRun
from padgs.scene import View, move_origin

WriteFrame = Callable[[np.ndarray], None]  # of [H, W, 3] uint8, or [H, W] uint16
DEPTH_STEPS = 1000  # of 16-bit depth, per scene scale
# Stated explicitly: by default, players take large videos to be BT.709, and small ones to be BT.601.
COLOURS = {"colorspace": "bt709", "color_primaries": "bt709", "color_trc": "bt709", "color_range": "tv"}
SPHERICAL = UUID("ffcc8263-f855-4a93-8814-587a02521fdd").bytes
XML = (
    '<?xml version="1.0"?><rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
    'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/"><GSpherical:Spherical>true</GSpherical:Spherical>'
    "<GSpherical:Stitched>true</GSpherical:Stitched><GSpherical:ProjectionType>equirectangular</GSpherical:"
    "ProjectionType><GSpherical:StitchingSoftware>padgs</GSpherical:StitchingSoftware></rdf:SphericalVideo>"
)


def free_name(path: Path) -> Path:
    """Return the first of NAME.SUFFIX, NAME-2.SUFFIX, NAME-3.SUFFIX, ... that does not exist."""
    names = (path.with_stem(f"{path.stem}{'' if number == 1 else f'-{number}'}") for number in count(1))
    return next(name for name in names if not name.exists())


def views_along(
    run: LoadedRun,
    path: str | None,
    seconds: float | None,
    fps: float,
    width: int = 0,
    perspective_shape: tuple[int | None, float] | None = None,
) -> list[View]:
    """Return the views of a camera path through the scene of a run; a ValueError if a file is no camera path.

    `path` is a name of PATHS, or a JSON file of keyframes or of nerfstudio; None: `cameras`, or `orbit` if these share
    one centre. `seconds` None: 10, or the length stored in the file; `width` 0: that of the training views, half of it
    in perspective. `perspective_shape` is the height in pixels (None: 9/16 of the width) and the horizontal field of
    view in degrees; None renders panoramas.
    """
    scene, trained = run.scene, run.scene.train[0]
    path = path or ("orbit" if scene.has_single_center else "cameras")
    if perspective_shape is None:
        width = width or max(4, trained.width // 4 * 4)  # even sides, for videos
        lens: Camera = Panorama(width, width // 2)
    else:
        height, fov = perspective_shape
        width = width or max(2, trained.width // 4 * 2)
        lens = perspective(width, 2 * round(width * 9 / 32) if height is None else height, fov)
    frames = None if seconds is None else max(2, round(seconds * fps))
    if path in PATHS:
        poses = PATHS[path](scene, frames or max(2, round(10 * fps)))
    else:
        up = gravity(torch.stack([view.cam_from_world for view in scene.panoramas])).up
        source = transforms_file(run.config.data.path, run.config.data.format)
        to_data = trained.load_pixels is not None or bool(run.config.options.transform)  # else in the file's own world
        try:
            poses = read_path(Path(path), frames, up, source, fps=fps, to_data=to_data)
        except DataError as error:  # which would be taken for one of the run's data
            raise ValueError(str(error)) from error
        poses = move_origin(poses, scene.origin)
    return [
        View(f"frame {number}", pose.to(trained.cam_from_world), lens.width, lens.height, lens=lens)
        for number, pose in enumerate(poses)
    ]


def write_video(
    to: Path,
    views: Sequence[View],
    render: Callable[[View], Rendering],
    *,
    fps: float,
    scene_scale: float,
    depth: bool = False,
    origin: Tensor | None = None,
    spherical: bool = False,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Path]:
    """Render views and write them in order, one a frame; return the written videos or folders.

    `to` is an .mp4, or a folder for PNGs; files appear, and an existing video is replaced, when all frames are written.
    `depth`: also as colours in an .mp4 (bright is near), beside PNGs as distances along the rays: 16 bits,
    `DEPTH_STEPS` per `scene_scale`; and `depth.json`: unit, camera and pose of each frame in the world of the data set,
    where the scene has its `origin`. `spherical`: mark an .mp4 as a panorama.
    `progress` is called with the number of written frames.
    """
    is_mp4 = to.suffix.lower() == ".mp4"
    if to.suffix and not is_mp4 and not to.is_dir():
        raise ValueError(f"{to} is not an .mp4, the only video format; a folder for PNGs must have no suffix")
    if to.name.lower() == ".mp4":
        raise ValueError(f"{to} has no name before its suffix; name the video, such as {to.with_name('film.mp4')}")
    outputs = [to, to.with_name(f"{to.stem}-depth{to.suffix}" if is_mp4 else f"{to.name}-depth")] if depth else [to]
    unit = scene_scale / DEPTH_STEPS
    with ExitStack() as stack:
        if is_mp4:
            writers = [stack.enter_context(_mp4(path, views[0], fps, spherical)) for path in outputs]
        else:
            texts = ("", depth_unit(to, scene_scale))
            writers = [stack.enter_context(_folder(*each)) for each in zip(outputs, texts, strict=False)]
        for number, view in enumerate(views):
            rendering = render(view)
            writers[0](to_uint8(rendering.image))
            if depth:
                steps = (rendering.depth / unit).round().clamp(0, 2**16 - 1).cpu().numpy().astype(np.uint16)
                writers[1](depth_image(rendering, scene_scale) if is_mp4 else steps)
            progress(number + 1)
    if depth and not is_mp4:
        statement = {"measure": "ray", "unit": unit, "frames": _frames(views, origin)}
        write_atomically(outputs[1] / STATEMENT, json.dumps(statement, indent=1).encode())
    return outputs


def depth_unit(to: Path, scene_scale: float) -> str:
    """Return what the values of written depths mean; PNGs hold it as their description."""
    if to.suffix.lower() == ".mp4":
        return "depth: bright is near, black is empty; a folder of PNGs holds it in numbers"
    unit = scene_scale / DEPTH_STEPS
    return (
        f"depth: one step is {unit:.6g} world units of the data set along the ray; 0 is empty, 65535 is "
        f"{65535 * unit:.6g} or more; cameras in depth.json"
    )


def _frames(views: Sequence[View], origin: Tensor | None) -> dict[str, Any]:
    """Return camera and pose of each frame in the world of the data set."""
    frames: dict[str, Any] = {}
    for number, view in enumerate(views, start=1):
        lens, pose = view.camera, view.cam_from_world.double().cpu()
        kind = {"model": type(lens).__name__.lower()}
        numbers = vars(lens) if isinstance(lens, Panorama | Pinhole) else {"width": lens.width, "height": lens.height}
        pose = pose if origin is None else move_origin(pose, -origin.cpu())
        frames[f"{number:05d}"] = {"camera": kind | numbers, "cam_from_world": pose.tolist()}
    return frames


@contextmanager
def _folder(path: Path, description: str) -> Iterator[WriteFrame]:
    path.mkdir(parents=True, exist_ok=True)
    if stale := next((file for file in path.iterdir() if file.suffix == ".png"), None):
        raise ValueError(f"{path} already holds images, such as {stale.name}; choose another folder with --to")
    numbers, info = iter(range(1, 1 << 30)), PngInfo()
    if description:
        info.add_text("Description", description)
    with draft_of(path / "frames") as draft:  # an interrupted call must not block the next
        draft.mkdir()

        def write(frame: np.ndarray) -> None:
            Image.fromarray(frame).save(draft / f"{next(numbers):05d}.png", pnginfo=info)

        yield write
        for image in sorted(draft.iterdir()):
            image.replace(path / image.name)


@contextmanager
def _mp4(path: Path, view: View, fps: float, spherical: bool) -> Iterator[WriteFrame]:
    if view.width % 2 or view.height % 2:
        size = f"{view.width}x{view.height}"
        rule = "H.264 supports even sides only: choose a multiple of 4 for --width, an even --height, or a folder"
        raise ValueError(f"frames are {size}; {rule}")
    try:
        import av
    except ImportError as error:
        raise ValueError(f"writing {path} needs PyAV: {install_command('video')}; or give a folder for PNGs") from error
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as draft:
        with av.open(str(draft), "w") as video:
            options = {"crf": "18", **COLOURS}
            stream = video.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000), options=options)
            stream.width, stream.height, stream.pix_fmt = view.width, view.height, "yuv420p"

            def write(frame: np.ndarray) -> None:
                image = av.VideoFrame.from_ndarray(frame, format="rgb24")
                video.mux(stream.encode(image.reformat(format="yuv420p", dst_colorspace="ITU709")))

            yield write
            video.mux(stream.encode())  # flush the encoder
        if spherical:
            mark_spherical(draft)


def mark_spherical(video: Path) -> None:
    """Mark an .mp4 with one track, whose index is the last box, as an equirectangular panorama, in place."""
    with video.open("r+b") as file:
        *_, (kind, start, size) = _boxes(file, 0, file.seek(0, 2))
        assert kind == b"moov", "libavformat writes the index last"
        file.seek(start)
        index = file.read(size)
        at, length = next((at, length) for kind, at, length in _boxes(BytesIO(index), 8, size) if kind == b"trak")
        content = SPHERICAL + XML.encode()
        box = struct.pack(">I4s", 8 + len(content), b"uuid") + content
        file.seek(start)
        file.write(struct.pack(">I", size + len(box)) + index[4:at])
        file.write(struct.pack(">I", length + len(box)) + index[at + 4 : at + length] + box + index[at + length :])


def _boxes(file: BinaryIO, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield kind, position and size of the boxes between two positions."""
    while start < end:
        file.seek(start)
        size, kind = struct.unpack(">I4s", file.read(8))
        if size == 1:  # a 64-bit size follows
            (size,) = struct.unpack(">Q", file.read(8))
        size = size or end - start
        yield kind, start, size
        start += size
