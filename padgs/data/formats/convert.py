"""Conversion between formats: read and check everything, write to a temporary folder, then rename it."""

import shutil
from dataclasses import replace
from pathlib import Path

import torch

import padgs.data
from padgs.data.assemble import assemble
from padgs.data.capture import Capture, Cloud, DataError, DataOptions, Frame, Progress, Tracks, view_name
from padgs.data.cloud import initial_cloud
from padgs.data.depths import write_depths
from padgs.data.formats.writers import WRITERS, Content
from padgs.data.images import inspect, save_png
from padgs.data.masks import MASK_FOLDERS, MAX_HIDDEN, SCENE_MASKS, write_masks
from padgs.data.metres import KnownLength, moved, to_metres, unit_note, write_unit
from padgs.files import draft_of, refuse_working_folder
from padgs.scene import Scene


def convert(
    source: Path,
    destination: Path,
    to: str,
    *,
    format: str = "auto",
    options: DataOptions = DataOptions(),  # noqa: B008 - frozen dataclass
    known: KnownLength = KnownLength(),  # noqa: B008
    progress: Progress = lambda done, total: None,
) -> Scene:
    """Write a data set in the format `to` of `padgs.data.formats.writers.WRITERS`, and return the scene of the source.

    Images are copied byte for byte, unless they are reduced (`options.width`), padded or converted to sRGB. The split
    is written as decided; masks, including the row rule of 360Roam, become mask.png or masks/. `known` sets the scale
    of the written world. `progress` is called with (images written, total). A DataError says that `load` would refuse
    the source, or that the destination cannot be written; then it stays unchanged. An unknown format is a ValueError.
    """
    if to not in WRITERS:
        raise ValueError(f"unknown format {to!r}; known: {', '.join(WRITERS)}")
    if destination.is_symlink():
        destination = destination.resolve()
    refuse_working_folder(destination)
    if destination.exists() and (not destination.is_dir() or any(destination.iterdir())):
        raise DataError(f"{destination} exists; nothing is overwritten: remove it or choose another path")
    capture = padgs.data.read(source, format, options)
    scene = assemble(capture, replace(options, cameras="panoramas"))  # no other format has photographs beside them
    try:
        destination.parent.mkdir(parents=True, exist_ok=True)
        with draft_of(destination) as partial:
            partial.mkdir()
            content = _write_images(capture, scene, partial / "images", progress)
            if options.points != "auto":
                # In the world of the poses: the scene may be recentered.
                points, colors, _ = initial_cloud(capture, options.points)
                content = replace(content, cloud=Cloud(points, colors), tracks=None)
            scale, notes = 1.0, unit_note(capture.folder)
            if found := to_metres(content.frames, content.cloud, known):
                change, note = found
                scale, (frames, cloud) = change.scale, moved(content.frames, content.cloud, change)
                content, notes = replace(content, frames=frames, cloud=cloud), [note]
                scene = replace(scene, notes=(*scene.notes, note))
            for note in notes:
                write_unit(partial, note)
            write_masks({view.name: view.load_mask for view in (*scene.train, *scene.test)}, partial)
            shown = [mask.mean().item() for view in (*scene.train, *scene.test) if (mask := view.mask()) is not None]
            if shown and 1 - min(shown) > MAX_HIDDEN:  # which loading takes for an inverted mask, unless it is named
                name = next(path.name for path in partial.iterdir() if path.name in (SCENE_MASKS[0], MASK_FOLDERS[0]))
                note = f"mask: pictures show small parts of the sphere; train on {destination} with data.mask={name}"
                scene = replace(scene, notes=(*scene.notes, note))
            write_depths((*scene.train, *scene.test), partial, scale)
            WRITERS[to](content, partial)
            if destination.exists():
                destination.rmdir()
            partial.rename(destination)
    except OSError as error:
        raise DataError(f"cannot write {destination} ({error.strerror or error}); nothing was written") from error
    if not scene.test:
        note = f"split: no list states that every view is a training view; train on {destination} with data.split=all"
        scene = replace(scene, notes=(*scene.notes, note))
    return scene


def _write_images(capture: Capture, scene: Scene, target: Path, progress: Progress) -> Content:
    """Copy or re-encode the images, and return the content of the files beside them."""
    views = {view.name: view for view in (*scene.train, *scene.test)}
    frames: dict[str, Frame] = {}  # by view
    kept = [i for i, frame in enumerate(capture.frames) if view_name(frame.name) in views]
    for done, i in enumerate(kept):
        frame = capture.frames[i]
        view = views[view_name(frame.name)]
        image, name = inspect(frame.image), frame.name
        if image.width != view.width or image.crop is not None or image.converted:
            assert view.load_pixels is not None
            name = f"{view.name}.png"
            save_png(view.load_pixels(), target / name)
        else:
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(frame.image, target / name)
        frames[view.name] = replace(frame, name=name, width=view.width, height=view.height, mask=None)
        progress(done + 1, len(kept))
    sides = {"train": scene.train, "test": scene.test} if scene.test else {}
    split = {side: tuple(frames[view.name].name for view in part) for side, part in sides.items()}
    written = tuple(frames.values())
    return Content(written, capture.cloud, _kept_tracks(capture, kept, written), split)


def _kept_tracks(capture: Capture, kept: list[int], frames: tuple[Frame, ...]) -> Tracks | None:
    """Return the observations in the written frames, in pixels of the written images."""
    if capture.tracks is None or any(frame.width is None for frame in capture.frames):
        return None
    tracks = capture.tracks()
    position = torch.full((len(capture.frames),), -1)
    position[kept] = torch.arange(len(kept))
    frame = position[tracks.frame]
    seen = frame >= 0
    before, after = (torch.tensor([f.width for f in part], dtype=torch.float64) for part in (capture.frames, frames))
    scale = after[frame[seen]] / before[tracks.frame[seen]]
    return Tracks(frame[seen], tracks.point[seen], tracks.pixels[seen] * scale[:, None])
