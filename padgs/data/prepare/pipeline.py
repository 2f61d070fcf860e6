"""Pipeline of `padgs prepare`: from panoramas without poses, or a 360-degree video, to a data set.

Works in a hidden folder beside the destination, so that an interrupted call can be resumed. The destination appears
when it is complete.
"""

import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock, Timeout
from PIL import Image

from padgs.data.camera_paths import gravity
from padgs.data.capture import Cloud, DataError, DataOptions, Frame, Tracks, listed, view_name
from padgs.data.formats import colmap
from padgs.data.formats.colmap_lens import pycolmap_module
from padgs.data.formats.writers import Content, write_colmap
from padgs.data.images import ImageFile, decode
from padgs.data.masks import MASK_FOLDERS, write_masks
from padgs.data.metres import UPRIGHT, Z, moved, refuse_useless, to_metres, write_unit
from padgs.data.prepare import rig, sfm, work
from padgs.data.prepare.pairs import image_pairs, similarities
from padgs.data.prepare.sources import DAMAGED, Source, extract_frames, find_source, is_video
from padgs.data.prepare.work import Prepared, PrepareOptions, WorkFolder, digest_of
from padgs.data.scans import optional_module
from padgs.files import IMAGE_FOLDERS, refuse_working_folder
from padgs.geometry.similarity import Similarity

STEPS = ("frames", "images", "views", "features", "matches", "poses", "result")
_REMEDIES = (
    "take them closer together (of a video: --per-second), hide what moves with the camera in a mask (--mask), or try "
    "--accurate"
)
_LATE = ("threads", "level", "known", "mapper")  # options without influence on what the working folder keeps

Progress = Callable[[str, int, int], None]  # (one of STEPS, done, total)


def prepare(
    source: Path, destination: Path, options: PrepareOptions | None = None, progress: Progress = lambda *_: None
) -> Prepared:
    """Compute poses and points of panoramas by structure from motion. Results are reproducible on one machine.

    `source` is a folder of 2:1 panoramas (subfolders included), or a stitched 360-degree video. The destination does
    not exist, is empty, or was written by the same call; it gets images/, sparse/0 (COLMAP, camera EQUIRECTANGULAR),
    masks if there are any, and prepare.json. A DataError names unusable input, panoramas without a relative pose, or a
    full disk; intermediate results then stay in the hidden folder, and nothing is written to the destination.
    """
    options = options or PrepareOptions()
    work.check_options(source, options)
    if result := _existing(source, destination, options):
        return result
    if destination.name in (*IMAGE_FOLDERS, *MASK_FOLDERS) and destination.resolve().parent == source.resolve():
        raise DataError(f"{destination} would be read as the images or masks of {source}; choose another path")
    place = place_of(destination.absolute())
    lock = FileLock(place / work.LOCK)
    try:
        place.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
        if result := _existing(source, destination, options):  # of another process, in the meantime
            return result
        return _Job(source, destination.absolute(), place, options, progress).run()
    except Timeout as error:
        raise DataError(f"another process prepares {destination}; wait for it, or choose another path") from error
    except OSError as error:
        why = error.strerror or error
        way_out = "the same command resumes" if place.is_dir() else "its folder cannot be made: choose another path"
        raise DataError(f"cannot prepare {destination} ({why}); {way_out}") from error
    except MemoryError as error:
        way_out = "the same command with --threads 1 uses less, and resumes"
        raise DataError(f"cannot prepare {destination} (out of memory); {way_out}") from error
    except RuntimeError as error:  # of pycolmap, its database included
        message = _pycolmap_message(error, place / "log.txt")
        raise DataError(
            f"cannot prepare {destination} ({message}); if its disk is full, free some space and repeat the command, "
            f"which resumes; else remove {place} to start over"
        ) from error
    finally:
        if lock.is_locked and place.is_dir() and not any(place.glob("*.done")) and not (place / "database.db").exists():
            shutil.rmtree(place, ignore_errors=True)  # nothing to resume
        lock.release()


def place_of(destination: Path) -> Path:
    """Return the hidden folder for intermediate results, beside the destination."""
    return destination.with_name(f".{destination.name}.prepare")


def _existing(source: Path, destination: Path, options: PrepareOptions) -> Prepared | None:
    """Return the result of an earlier call; None if the destination is free, a DataError if something else is there."""
    if not destination.exists() or (destination.is_dir() and not any(destination.iterdir())):
        refuse_working_folder(destination)
        return None
    if result := work.find_result(source, destination, options):
        return result
    what = f"{destination} exists, and was not made of {source} with these options; nothing is overwritten"
    holds = source.resolve().is_relative_to(destination.resolve())
    raise DataError(f"{what}: {'it holds the input:' if holds else 'remove it or'} choose another path")


class _Job:
    def __init__(self, source: Path, target: Path, place: Path, options: PrepareOptions, progress: Progress) -> None:
        self.destination, self.work, self.options, self.progress = target, place, options, progress
        self.folder = WorkFolder(place)
        given = None
        if is_video(source):
            optional_module("av", source, "video")  # before the file is read
            of_video = work.fingerprint(source, options)
            given = digest_of(of_video, options)
            self.folder.open("video", f"{of_video.partition('|')[0]}|{options.per_second}")
            self.folder.run_once("frames", partial(self._extract_frames, source))
            source = self.work / "frames"
        with self.folder.step("images"):
            self.source: Source = find_source(source, options.mask)
            refuse_useless(options.known, {name: image.path for name, image in self.source.images.items()})
        width, height = max((image.width, image.height) for image in self.source.images.values())
        size = (round(width / math.pi),) * 2 if options.accurate else (width, height)
        self.threads = options.threads or work.threads_for(*size)
        kept = ("video.sha256", "frames", "frames.done") if source.parent == self.work else ()
        self.folder.open("images", digest_of(self.source.fingerprint, options, _LATE), keep=kept)
        self.input = given or digest_of(self.source.fingerprint, options)
        # Short names, because pycolmap's list of pairs does not support spaces.
        numbered = enumerate(self.source.images.items())
        self.files = {f"{index:06d}{_suffix(image)}": name for index, (name, image) in numbered}
        self.paths = {short: self.source.images[name].path for short, name in self.files.items()}
        self.views = rig.VIEWS_PER_ROW * len(rig.LATITUDES) if options.accurate else 1
        self.database = self.work / "database.db"
        self.feature_images = self.work / ("views" if options.accurate else "images")

    def run(self) -> Prepared:
        """Run all steps that are not done."""
        links = {self.work / "images" / short: path for short, path in self.paths.items()}
        if not all(link.exists() and (not link.is_symlink() or link.samefile(links[link])) for link in links):  # moved
            (self.work / "views.done").unlink(missing_ok=True)
        with sfm.log_to(self.work / "log.txt"):
            self.folder.run_once("views", self._link_images)
            self.folder.run_once("features", self._extract_features)
            self.folder.run_once("matches", self._match)
            self.folder.run_once("poses", self._reconstruct, self.options.mapper)
            with self.folder.step("result"):
                return self._write()

    def _extract_frames(self, video: Path) -> None:
        (self.work / "frames").mkdir(exist_ok=True)
        extract_frames(video, self.work / "frames", self.options.per_second, partial(self.progress, "frames"))

    def _link_images(self) -> None:
        images, masks = self.folder.empty("images"), self.folder.empty("masks")
        for short, name in self.files.items():
            image, mask = self.source.images[name], self.source.masks.get(name)
            if not short.endswith(".panorama.png"):
                work.link_or_copy(image.path, images / short)
            else:
                Image.fromarray(decode(image.path)).save(images / short, compress_level=1)
            if self.source.masks:
                use = np.ones((image.height, image.width), bool) if mask is None else mask().numpy() >= 0.5
                Image.fromarray(use * np.uint8(255)).save(masks / f"{short}.png", compress_level=1)
        if self.options.accurate:
            sizes = sorted({(image.width, image.height) for image in self.source.images.values()})
            if len(sizes) > 1:
                found = f"the panoramas have {len(sizes)} sizes ({listed(f'{w}x{h}' for w, h in sizes)})"
                raise DataError(f"{found}; --accurate needs one: resize them, or omit it")
            mask_files = {short: masks / f"{short}.png" for short in self.files} if self.source.masks else {}
            folders = self.work / "views", self.work / "view_masks"
            rig.render_views(self.paths, mask_files, *folders, partial(self.progress, "views"))

    def _extract_features(self) -> None:
        masks = self.work / ("view_masks" if self.options.accurate else "masks")
        given = masks if self.options.accurate or self.source.masks else None
        progress = partial(self._progress, "features")
        sfm.extract_features(self.database, self.feature_images, self._groups(), given, self.threads, progress)
        if self.options.accurate:
            with pycolmap_module().Database.open(self.database) as entries:
                pycolmap_module().apply_rig_config([rig.rig_config()], entries)

    def _groups(self) -> list[sfm.Group]:
        """Group images that share a camera: panoramas of one size, or one view of all panoramas."""
        if self.options.accurate:
            lens = rig.view_lens(next(iter(self.source.images.values())).width)
            names = [tuple(rig.view_name(view, short) for short in self.files) for view in range(self.views)]
            return [sfm.Group(some, lens.width, lens.height, lens.fx) for some in names]
        by_size: dict[tuple[int, int], list[str]] = {}
        for short, image in zip(self.files, self.source.images.values(), strict=True):
            by_size.setdefault((image.width, image.height), []).append(short)
        return [sfm.Group(tuple(names), *size) for size, names in by_size.items()]

    def _match(self) -> None:
        views = {name: [short] for short, name in self.files.items()}  # original name -> images with features
        if self.options.accurate:
            views = {name: [rig.view_name(i, short) for i in range(self.views)] for name, [short] in views.items()}

        def similarity(names: Sequence[str]) -> np.ndarray:
            return similarities(self.database, [views[name] for name in names], self.options.seed)

        pairs = [[*product(views[a], views[b])] for a, b in image_pairs(list(views), self.options.pairs, similarity)]
        progress = partial(self._progress, "matches")
        sfm.match(self.database, pairs, self.options.accurate, self.threads, self.options.seed, progress)

    def _reconstruct(self) -> None:
        folders = self.database, self.feature_images, self.folder.empty("parts")
        rest = self.threads, self.options.seed, self.views, partial(self.progress, "poses"), self.options.mapper
        if not sfm.reconstruct(*folders, *rest):
            raise DataError(f"no relative pose was found for any two of the {len(self.files)} panoramas; {_REMEDIES}")

    def _write(self) -> Prepared:
        self.progress("result", 0, 1)
        parts = map(pycolmap_module().Reconstruction, sorted((self.work / "parts").iterdir()))
        model, *others = sorted(parts, key=lambda part: -part.num_reg_frames())
        sfm.refine(model, self.threads)
        frames, cloud, tracks = self._panoramas(model)
        notes, partial_folder = list(self.source.notes), self.folder.empty("out")
        if (damaged := self.work / "frames" / DAMAGED).is_file():
            notes.append(damaged.read_text(encoding="utf-8"))
        if self.options.level:
            frames, cloud, note = level_world(frames, cloud)
            notes.append(note)
        note = "the scale of the world is arbitrary: --metres, --camera-height and --gps set it"
        if found := to_metres(frames, cloud, self.options.known):
            change, note = found
            frames, cloud = moved(frames, cloud, change)
            write_unit(partial_folder, note)
        notes.append(note)
        registered = tuple(frame.name for frame in frames)
        if unregistered := tuple(name for name in self.files.values() if name not in set(registered)):
            lost = f"{len(unregistered)} of {len(self.files)} panoramas"
            notes.append(f"{lost} have no pose: {listed(unregistered)}; {_REMEDIES}")
        if others:
            sizes = listed(part.num_reg_frames() for part in others)
            notes.append(f"{len(others)} smaller part(s) of {sizes} panoramas are not connected to the largest")
        sizes = (len(cloud.points), len(tracks.frame))
        result = Prepared(self.destination, registered, unregistered, *sizes, self.folder.seconds, tuple(notes))
        for frame in frames:
            target = partial_folder / "images" / frame.name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(frame.image, target)
        write_masks({view_name(frame.name): self.source.masks.get(frame.name) for frame in frames}, partial_folder)
        write_colmap(Content(frames, cloud, tracks, {}), partial_folder)
        result.write(partial_folder, self.options, self.input)
        if self.destination.exists():
            self.destination.rmdir()
        partial_folder.rename(self.destination)
        for marker in self.work.glob("*.sha256"):  # first, so that nothing resumes where only a part is deleted
            marker.unlink()
        shutil.rmtree(self.work, ignore_errors=True)
        self.progress("result", 1, 1)
        return result

    def _panoramas(self, model: Any) -> tuple[tuple[Frame, ...], Cloud, Tracks]:
        """Return frames with their original names, points and observations."""
        if self.options.accurate:
            frames, cloud, tracks = rig.panoramas(model, self.paths, next(iter(self.source.images.values())).width)
        else:
            refined = self.folder.empty("refined")
            model.write_binary(str(refined))
            capture = colmap.read(self.work, DataOptions(images="images"), refined)
            assert capture.cloud is not None and capture.tracks is not None
            frames, cloud, tracks = capture.frames, capture.cloud, capture.tracks()
        named = (replace(frame, name=self.files[frame.name], image=self.paths[frame.name]) for frame in frames)
        return tuple(named), cloud, tracks

    def _progress(self, step: str, done: int, total: int) -> None:
        """Report a batch, and stop before the next one if the disk is full."""
        self.progress(step, done, total)
        work.refuse_full(self.work)


def _suffix(image: ImageFile) -> str:
    """Return the suffix of an image for pycolmap; another one if it must be decoded for it."""
    is_read = image.format != "WEBP" and image.crop is None and not image.converted
    return image.path.suffix if is_read else ".panorama.png"


def _pycolmap_message(error: Exception, log: Path) -> str:
    """Return pycolmap's error and last logged warning, without positions in its source."""
    logged = log.read_text(encoding="utf-8", errors="replace").splitlines()[-1:] if log.is_file() else []
    messages = [str(error).strip(), *(line for line in logged if line[:1] in ("W", "E", "F"))]
    return "; ".join(dict.fromkeys(line.rpartition("] ")[2] for line in messages))


def level_world(frames: tuple[Frame, ...], cloud: Cloud) -> tuple[tuple[Frame, ...], Cloud, str]:
    """Rotate the world so that +z is the cameras' common up, if they have one; also returns a note."""
    estimate = gravity(torch.stack([frame.cam_from_world for frame in frames]))
    if estimate.agreement < UPRIGHT:
        return frames, cloud, "the cameras have no common up direction; the world is not rotated"
    change = Similarity.turning(torch.tensor(estimate.up, dtype=torch.float64), Z)
    return *moved(frames, cloud, change), "the world's +z is the cameras' common up direction"
