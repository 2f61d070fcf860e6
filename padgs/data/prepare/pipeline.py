"""Pipeline."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from padgs.data.assemble import IMAGE_FOLDERS, view_name
from padgs.data.camera_paths import gravity
from padgs.data.capture import Cloud, DataError, DataOptions, Frame, Tracks, listed
from padgs.data.formats import colmap
from padgs.data.formats.writers import Content, write_colmap
from padgs.data.images import decode
from padgs.data.masks import write_masks
from padgs.data.prepare import rig, sfm
from padgs.data.prepare.sfm import image_pairs
from padgs.data.prepare.sources import Source, extract_frames, find_source, is_video
from padgs.data.prepare.work import (
    Prepared,
    PrepareOptions,
    WorkFolder,
    digest_of,
    fingerprint,
    finished,
    link_or_copy,
    refuse_full,
    threads_for,
)

STEPS = ("frames", "images", "views", "features", "matches", "poses", "result")
_REMEDIES = (
    "take them closer together (of a video: --per-second), hide what moves with the camera in a mask (--mask), or try "
    "--accurate"
)

Progress = Callable[[str, int, int], None]  # (one of STEPS, done, in all)


def prepare(
    source: Path,
    destination: Path,
    options: PrepareOptions | None = None,
    progress: Progress = lambda step, done, total: None,
) -> Prepared:
    """Find poses and points for panoramas by structure from motion.

    Args:
        source: a folder of 2:1 panoramas (subfolders included), or a stitched 360-degree video.
        destination: a folder that does not exist yet, or is empty, or what the same call has made. It gets images/,
            sparse/0 (COLMAP, camera EQUIRECTANGULAR), masks if there are any, and prepare.json.
        options: None: the defaults. The same options, input and machine give the same result.
        progress: called with (step, done, in all).

    Raises:
        DataError: input that cannot be used, no two images that can be placed, or a full disk. What was found so far
            stays in the hidden folder beside the destination; nothing is at the destination.
    """
    options = options or PrepareOptions()
    if destination.exists() and (not destination.is_dir() or any(destination.iterdir())):
        if already := finished(source, destination, options):
            return already
        raise DataError(
            f"{destination} exists, and is not what these options make of {source}; nothing is overwritten: remove it "
            "or choose another place"
        )
    if destination.name in (*IMAGE_FOLDERS, "masks") and destination.resolve().parent == source.resolve():
        raise DataError(
            f"{destination} would be taken for the images or masks of {source}; choose another name or another place"
        )
    work = destination.absolute().with_name(f".{destination.name}.prepare")
    try:
        return _Job(source, destination.absolute(), work, options, progress).run()
    except OSError as error:
        raise DataError(
            f"cannot prepare {destination} ({error.strerror or error}); the same command goes on where this stopped"
        ) from error
    except MemoryError as error:
        raise DataError(
            f"cannot prepare {destination} (out of memory); the same command with --threads 1 takes less, and goes on "
            "where this stopped"
        ) from error
    except RuntimeError as error:  # pycolmap's: all that its database has to say, too
        said = _said(error, work / "log.txt")
        raise DataError(
            f"cannot prepare {destination} ({said}); if its disk is full, make room and give the same command, "
            f"which goes on where this stopped; else remove {work} to start over"
        ) from error
    finally:
        if work.is_dir() and not any(work.glob("*.done")) and not (work / "database.db").exists():
            shutil.rmtree(work, ignore_errors=True)  # nothing in it that would be worth going on from


class _Job:
    """One preparation in its working folder."""

    def __init__(
        self, source: Path, destination: Path, work: Path, options: PrepareOptions, progress: Progress
    ) -> None:
        self.destination, self.work, self.options, self.progress = destination, work, options, progress
        self.folder = WorkFolder(work)
        given = None
        if is_video(source):
            given = digest_of(fingerprint(source, options), options)
            self.folder.open("video", given)
            self.folder.once("frames", partial(self._extract_frames, source))
            source = self.work / "frames"
        with self.folder.step("images"):
            self.source: Source = find_source(source, options.mask)
        first = next(iter(self.source.images.values()))
        self.threads = options.threads or threads_for(first.width, first.height)
        of_video = ("video.sha256", "frames", "frames.done") if source.parent == self.work else ()
        of_images = digest_of(self.source.fingerprint, options)
        self.folder.open("images", of_images, keep=of_video)
        self.input = given or of_images  # of a video or images
        # pycolmap's list of pairs knows no spaces, so it gets names of ours.
        self.files = {f"{index:06d}{_ending(name)}": name for index, name in enumerate(self.source.images)}
        self.paths = {short: self.source.images[name].path for short, name in self.files.items()}
        self.views = rig.VIEWS_PER_ROW * len(rig.LATITUDES) if options.accurate else 1
        self.database = self.work / "database.db"
        self.pictures = self.work / ("views" if options.accurate else "images")  # in which features are found

    def run(self) -> Prepared:
        """All steps; those that are done already are skipped."""
        with sfm.log_to(self.work / "log.txt"):
            self.folder.once("views", self._lay_out)
            self.folder.once("features", self._find_features)
            self.folder.once("matches", self._match)
            self.folder.once("poses", self._place)
            with self.folder.step("result"):
                return self._write()

    # Steps, in order.

    def _extract_frames(self, video: Path) -> None:
        (self.work / "frames").mkdir(exist_ok=True)
        extract_frames(video, self.work / "frames", self.options.per_second, partial(self.progress, "frames"))

    def _lay_out(self) -> None:
        images, masks = self.folder.empty("images"), self.folder.empty("masks")
        for short, name in self.files.items():
            image, mask = self.source.images[name], self.source.masks.get(name)
            if Path(short).suffix == image.path.suffix:
                link_or_copy(image.path, images / short)
            else:
                Image.fromarray(decode(image.path)).save(images / short, compress_level=1)
            if self.source.masks:
                use = np.ones((image.height, image.width), bool) if mask is None else mask().numpy() >= 0.5
                Image.fromarray(use * np.uint8(255)).save(masks / f"{short}.png", compress_level=1)
        if self.options.accurate:
            self._render_views()

    def _render_views(self) -> None:
        sizes = {(image.width, image.height) for image in self.source.images.values()}
        if len(sizes) > 1:
            raise DataError(
                f"the panoramas have {len(sizes)} sizes ({listed(f'{w}x{h}' for w, h in sorted(sizes))}); --accurate "
                "needs one: resize them, or do without it"
            )
        rig.render_views(
            self.paths,
            {short: self.work / "masks" / f"{short}.png" for short in self.files} if self.source.masks else {},
            self.work / "views",
            self.work / "view_masks",
            partial(self.progress, "views"),
        )

    def _find_features(self) -> None:
        masks = self.work / ("view_masks" if self.options.accurate else "masks")
        given = masks if self.options.accurate or self.source.masks else None
        tell = partial(self._tell, "features")
        sfm.extract_features(self.database, self.pictures, self._groups(), given, self.threads, tell)
        if self.options.accurate:
            sfm.make_rig(self.database, rig.rig_config())

    def _groups(self) -> list[sfm.Group]:
        """Images that share a camera: panoramas of one size, or one view of all panoramas."""
        if self.options.accurate:
            lens = rig.view_lens(next(iter(self.source.images.values())).width)
            return [
                sfm.Group(tuple(rig.view_name(view, short) for short in self.files), lens.width, lens.height, lens.fx)
                for view in range(self.views)
            ]
        by_size: dict[tuple[int, int], list[str]] = {}
        for short, name in self.files.items():
            image = self.source.images[name]
            by_size.setdefault((image.width, image.height), []).append(short)
        return [sfm.Group(tuple(names), *size) for size, names in by_size.items()]

    def _match(self) -> None:
        short = {name: short for short, name in self.files.items()}
        # Of the names as they were given: ours are in the order of their letters, where 10 comes before 2.
        pairs = [[(short[a], short[b])] for a, b in image_pairs(list(short), self.options.pairs)]
        if self.options.accurate:
            both = list(product(range(self.views), repeat=2))
            pairs = [[(rig.view_name(i, a), rig.view_name(j, b)) for i, j in both] for [(a, b)] in pairs]
        tell = partial(self._tell, "matches")
        sfm.match(self.database, pairs, self.options.accurate, self.threads, self.options.seed, tell)

    def _place(self) -> None:
        parts = self.folder.empty("parts")
        tell = partial(self.progress, "poses")
        if not sfm.reconstruct(self.database, self.pictures, parts, self.threads, self.options.seed, self.views, tell):
            raise DataError(f"no two of the {len(self.files)} panoramas could be placed together; {_REMEDIES}")

    def _write(self) -> Prepared:
        self.progress("result", 0, 1)
        model, others = self._largest_part()
        sfm.refine(model, self.threads)
        frames, cloud, tracks = self._panoramas(model)
        notes = list(self.source.notes)
        if self.options.level:
            frames, cloud, note = levelled(frames, cloud)
            notes.append(note)
        registered = tuple(frame.name for frame in frames)
        unregistered = tuple(name for name in self.files.values() if name not in set(registered))
        if unregistered:
            notes.append(
                f"{len(unregistered)} of {len(self.files)} panoramas could not be placed: {listed(unregistered)}; "
                f"{_REMEDIES}"
            )
        if others:
            notes.append(f"{len(others)} smaller part(s) of {listed(others)} panoramas have no connection to the rest")
        seconds = self.folder.seconds
        result = Prepared(
            self.destination, registered, unregistered, len(cloud.points), len(tracks.frame), seconds, tuple(notes)
        )
        partial_folder = self.folder.empty("out")
        self._copy_images(frames, partial_folder)
        write_colmap(Content(frames, cloud, tracks, {}), partial_folder)
        result.write(partial_folder, self.options, self.input)
        if self.destination.exists():
            self.destination.rmdir()
        partial_folder.rename(self.destination)
        shutil.rmtree(self.work, ignore_errors=True)
        self.progress("result", 1, 1)
        return result

    def _largest_part(self) -> tuple[Any, list[int]]:
        """The part with most panoramas, and the sizes of the others."""
        pycolmap = colmap.pycolmap_module()
        parts = [pycolmap.Reconstruction(str(path)) for path in sorted((self.work / "parts").iterdir())]
        parts.sort(key=lambda part: -part.num_reg_frames())
        return parts[0], [part.num_reg_frames() for part in parts[1:]]

    def _panoramas(self, model: Any) -> tuple[tuple[Frame, ...], Cloud, Tracks]:
        """Frames under their own names, points and observations."""
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

    def _copy_images(self, frames: tuple[Frame, ...], folder: Path) -> None:
        for frame in frames:
            target = folder / "images" / frame.name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(frame.image, target)
        write_masks({view_name(frame.name): self.source.masks.get(frame.name) for frame in frames}, folder)

    def _tell(self, step: str, done: int, total: int) -> None:
        """Tell of a batch, and do not begin another on a full disk."""
        self.progress(step, done, total)
        refuse_full(self.work)


def _ending(name: str) -> str:
    """Of a picture as pycolmap gets it."""
    ending = Path(name).suffix
    return ending if ending.lower() in sfm.ENDINGS else ".png"


def _said(error: Exception, log: Path) -> str:
    """What pycolmap says, and has logged at last if that is a complaint, without the places in its source."""
    logged = log.read_text(encoding="utf-8", errors="replace").splitlines()[-1:] if log.is_file() else []
    said = [str(error).strip(), *(line for line in logged if line[:1] in ("W", "E", "F"))]
    return "; ".join(dict.fromkeys(line.rpartition("] ")[2] for line in said))


LEVEL_AGREEMENT = 0.9  # length of the mean of the cameras' up directions from which they have a common one


def levelled(frames: tuple[Frame, ...], cloud: Cloud) -> tuple[tuple[Frame, ...], Cloud, str]:
    """The same in a world whose +z is the cameras' common up, if they have one, and a note."""
    found = gravity(torch.stack([frame.cam_from_world for frame in frames]))
    if found.agreement < LEVEL_AGREEMENT:
        return frames, cloud, "the cameras have no common up; the world stays as structure from motion left it"
    new_from_old = rotation_between(torch.tensor(found.up, dtype=torch.float64))
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = new_from_old.mT
    frames = tuple(replace(frame, cam_from_world=frame.cam_from_world @ turn) for frame in frames)
    cloud = Cloud(cloud.points @ new_from_old.mT, cloud.colors)
    return frames, cloud, "the world's +z is the common up of the cameras; its scale is arbitrary"


def rotation_between(up: Tensor) -> Tensor:
    """The smallest rotation [3, 3] that takes a unit vector [3] to +z.

    >>> rotation_between(torch.tensor([0.0, -1.0, 0.0]))
    tensor([[ 1.,  0.,  0.],
            [ 0.,  0.,  1.],
            [ 0., -1.,  0.]])
    """
    x, y, z = up.tolist()
    if z < -1 + 1e-9:
        return torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=up.dtype))
    k = 1 / (1 + z)
    rows = ((1 - k * x * x, -k * x * y, -x), (-k * x * y, 1 - k * y * y, -y), (x, y, z))
    return torch.tensor(rows, dtype=up.dtype) + 0.0
