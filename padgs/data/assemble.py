"""Build a scene from a capture: find and check its images, split, mask, and compute the fingerprint."""

import hashlib
import os
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
from pathlib import Path, PurePosixPath

import torch
from torch import Tensor

from padgs.data.camera_paths import centers
from padgs.data.capture import OTHERS, Capture, DataError, DataOptions, Frame, UnknownLens, first_of, listed, view_name
from padgs.data.cloud import initial_cloud
from padgs.data.depths import FOLDERS as DEPTH_FOLDERS
from padgs.data.depths import with_depths
from padgs.data.images import EXTENSIONS, ImageFile, inspect, notes_on
from padgs.data.masks import find_masks, is_of_masks, masks_beside
from padgs.data.metres import unit_note
from padgs.data.splits import is_inside, spellings, split_frames
from padgs.data.store import ImageStore, StoredImage, cache_root
from padgs.files import IMAGE_FOLDERS, file_name, folded, given_path
from padgs.geometry.camera import sphere_share
from padgs.scene import Scene, View

MAX_GAP = 100  # between cameras and points, times the median distances within both
MIN_SIDE = 3  # pixels of a photograph, whose solid angles are differences of rays
HIDDEN = (".", "__MACOSX", "@eaDir", "@Recycle", "#recycle")  # beginnings of names; network drives keep previews there
PREPARED = "prepare.json"  # written by `padgs.data.prepare`
# Files that identify a prepared data set, and a run (see `padgs.results`). Searches for images skip such folders: they
# hold renders, or copies of images.
SKIPPED = ((PREPARED,), ("config.yaml", "renders"))


def assemble(capture: Capture, options: DataOptions) -> Scene:
    """Build the scene of a capture; a DataError if training cannot use it. Images are checked, but not decoded."""
    refuse_clashes([frame.name for frame in capture.frames])
    capture = _without_unlisted(capture, options)
    # Panoramas first: the first view stands for all where only one is looked at.
    frames = sorted(capture.frames, key=lambda frame: (frame.lens is not None, frame.name))
    panoramas = sum(frame.lens is None for frame in frames)
    left_out = options.cameras == "panoramas"
    capture = replace(capture, frames=tuple(frames[:panoramas] if left_out else frames))
    if unknown := next((frame.lens for frame in capture.frames if isinstance(frame.lens, UnknownLens)), None):
        unknown(0, 0)
    names = [frame.name for frame in capture.frames]
    if not names:
        where = f"the {capture.format} model in {capture.folder}"
        raise DataError(f"{where} holds no posed image; export the poses again, or run `padgs prepare IMAGES OUT`")
    if not panoramas:
        raise DataError(
            f"all {len(frames)} images of {capture.folder} are of other cameras ({frames[0].name}), which can be used "
            "beside panoramas (EQUIRECTANGULAR) only: reconstruct from the panoramas themselves (`padgs prepare`), or "
            "give the sparse_equirectangular model" + "".join(f"; {note}" for note in capture.notes if OTHERS in note)
        )
    _refuse_missing(capture)
    images = [inspect(frame.image, panorama=frame.lens is None) for frame in capture.frames]
    notes = [*capture.notes, *unit_note(capture.folder), *_camera_notes(capture.frames, images), *notes_on(images)]
    target = options.width
    if target is None and capture.width is not None and images[0].width > capture.width:
        target = capture.width
    factor = 1.0 if target is None else target / images[0].width  # of photographs beside panoramas
    if target and (small := next((image for image in images[:panoramas] if image.width < target), None)):
        raise DataError(f"data.width={target} is wider than {small.path} ({small.width}); images are only reduced")
    sizes = [(image.width, image.height) if target is None else (target, target // 2) for image in images[:panoramas]]
    sizes += [
        (max(MIN_SIDE, round(factor * image.width)), max(MIN_SIDE, round(factor * image.height)))
        for image in images[panoramas:]
    ]
    whole = zip(images[:panoramas], sizes, strict=False)
    if reduced := {(image.width, image.height) for image, size in whole if size[0] < image.width}:
        stored = listed(f"{width}x{height}" for width, height in sorted(reduced))
        notes.append(f"images: reduced from {stored} to {target}x{sizes[0][1]} by an area filter")
    if panoramas < len(frames):
        use = "left out (data.cameras=panoramas)" if left_out else "used, each by the share of the sphere that it shows"
        notes.append(f"cameras: {len(frames) - panoramas} of {len(frames)} images are no panoramas; they are {use}")
    unposed: list[str] = []
    if capture.image_folder != capture.folder:  # which may hold masks and other images too
        posed = {frame.image for frame in frames}
        unposed = [name for name in image_names(capture.image_folder) if capture.image_folder / name not in posed]
    if unposed:
        notes.append(f"{len(unposed)} images have no pose and are not used: {listed(unposed)}")
    rules = {"mode": options.split, "every": options.test_every, "stated": capture.split}
    photographs = [frame.name for frame in frames[panoramas:]] if left_out else []
    split = split_frames(names, *capture.places, unposed=unposed, left_out=photographs, **rules)
    if min(split.train) >= panoramas:
        raise DataError("the train split holds no panorama, only photographs; name a panorama, or set data.split=every")
    points, colors, cloud_notes = initial_cloud(capture, options.points)
    _refuse_other_world(capture, points)
    folder, cache_notes = disk_cache(options, 3 * sum(width * height for width, height in sizes))
    store = ImageStore(options.cache_bytes, options.prefetch_threads, options.device, folder)
    masks, mask_digests, mask_notes = find_masks(capture, options.mask, images, sizes, store)
    views = []
    for frame, size, mask in zip(capture.frames, sizes, masks, strict=True):
        lens = frame.lens and frame.lens(*size)
        pixels = StoredImage(frame.image, *size, store)
        view = View(view_name(frame.name), frame.cam_from_world, *size, pixels, mask, lens, share=frame.share)
        views.append(view if lens is None else replace(view, sphere_share=sphere_share(lens)))
    views, depth_digests, depth_notes = with_depths(views, capture, options)
    folder, around = (Path(os.path.abspath(capture.places[i])) for i in (0, -1))  # also of "."; a link keeps its name
    name = capture.name or (around if folder.is_relative_to(around) else folder).name  # that of a file in export/
    train, test = (tuple(views[i] for i in part) for part in (split.train, split.test))
    all_notes = (*notes, *split.notes, *mask_notes, *depth_notes, *cloud_notes, *cache_notes)
    scene = Scene(name, train, test, points, colors, fingerprint="", notes=all_notes).recentered()
    digest = hashlib.sha256()
    for view, image in zip(views, images, strict=True):
        digest.update(f"{view.name}|{view.width}x{view.height}|{image.digest}|".encode())
        if view.lens is not None:
            digest.update(view.lens.rays().numpy().tobytes())
    digest.update(_rounded(torch.stack([view.cam_from_world for view in views])).numpy().tobytes())
    digest.update(f"train{split.train}test{split.test}masks{mask_digests}".encode())
    if any(view.share != 1 for view in views):
        digest.update(f"shares{[view.share for view in views]}".encode())
    if depth_digests:
        digest.update(f"depths{depth_digests}".encode())
    digest.update(scene.points.numpy().tobytes())
    digest.update(colors.numpy().tobytes())
    return replace(scene, fingerprint=digest.hexdigest())


def _rounded(poses: Tensor) -> Tensor:
    """Return poses [F, 4, 4] in millionths, without the bits in which processors differ; lengths by the largest."""
    lengths = poses[:, :3, 3].abs().max().clamp(min=1e-300)
    return torch.cat((poses[:, :3, :3], poses[:, :3, 3:] / lengths), -1).mul(2.0**20).round().long()


def _refuse_other_world(capture: Capture, points: Tensor) -> None:
    """Refuse points that cannot belong to the cameras, such as in local beside map coordinates."""
    positions = centers(torch.stack([frame.cam_from_world for frame in capture.frames]))
    (camera, reach), (point, spread) = (
        (middle, (of - middle).norm(dim=1).median()) for of in (positions, points) for middle in [of.median(0).values]
    )
    if reach > 0 and (gap := (point - camera).norm()) > MAX_GAP * (reach + spread):
        places = (f"({', '.join(f'{number:.6g}' for number in middle.tolist())})" for middle in (camera, point))
        raise DataError(
            "the cameras are around {}, the points around {}: ".format(*places)
            + f"{gap:.3g} apart, {gap / (reach + spread):.2g} times as much as they spread, so not in one world; "
            "export both in the same coordinates (Metashape: points in local coordinates), or set data.points=random"
        )


def disk_cache(options: DataOptions, size: int) -> tuple[Path | None, list[str]]:
    """Return the folder for decoded images beyond the memory, and a note; no folder if they would take half of the free
    space and of what the cache holds, which may be these images.
    """
    if size <= options.cache_bytes or options.disk_cache == "off":
        return None, []
    gigabytes = f"{size / 1e9:.1f} GB of decoded images exceed data.cache_bytes"
    folder = Path(options.disk_cache) if options.disk_cache != "auto" else cache_root() / "images"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(folder).free + sum(file.stat().st_size for file in folder.iterdir() if file.is_file())
    except OSError as error:
        why = f"cannot write {folder}: {error.strerror}"
        if options.disk_cache == "auto":
            return None, [f"images: {gigabytes}, and the disk cache {why}; each is decoded when it is needed"]
        raise DataError(f"data.disk_cache: {why}; name another folder, or off") from error
    if 2 * size > free:
        return None, [f"images: {gigabytes} and half of the free space of {folder}; each is decoded when it is needed"]
    return folder, [f"images: {gigabytes}, they are kept in {folder} (data.disk_cache; it may be deleted)"]


def image_folder(folder: Path, given: str | None, usual: Sequence[str] = IMAGE_FOLDERS) -> Path:
    """Return the given folder (a DataError if missing), else the first usual one that exists, else that of the data."""
    if given is not None:
        if not (found := given_path(given, folder)).is_dir():
            raise DataError(f"data.images={given}: there is no folder {found}; name it from {folder} or from here")
        return found
    return first_of(folder, usual, Path.is_dir) or folder


def image_names(folder: Path) -> list[str]:
    """Return the names of all images below a folder, as in `file_names`, without the masks beside them."""
    names = [name for name in file_names(folder) if name.lower().endswith(EXTENSIONS)]
    masks = {folded(mask) for name in names for mask in masks_beside(name)}
    return [name for name in names if folded(name) not in masks]


def file_names(folder: Path) -> list[str]:
    """Return all files below a folder, relative to it and sorted, without hidden and `SKIPPED` ones; links count."""
    found: list[str] = []
    seen: set[Path] = set()
    for parent, folders, files in os.walk(folder, followlinks=True):
        here = Path(parent)
        is_skipped = here != folder and any(all((here / file).exists() for file in signs) for signs in SKIPPED)
        if is_skipped or here.resolve() in seen:  # a link may lead back
            folders.clear()
            continue
        seen.add(here.resolve())
        folders[:] = sorted(name for name in folders if not name.startswith(HIDDEN))
        found += [(here / name).relative_to(folder).as_posix() for name in files if not name.startswith(HIDDEN)]
    return sorted(found)


def refuse_clashes(names: Sequence[str]) -> None:
    """Refuse images whose views would share a file: names that differ only in case, extension, or signs such as /."""
    seen: dict[str, str] = {}
    for name in names:
        key = file_name(view_name(name)).casefold()
        if seen.get(key) == name:
            raise DataError(f"the image {name!r} has two poses; remove one")
        if key in seen:
            both = f"{seen[key]!r} and {name!r}"
            raise DataError(f"the images {both} would share one name (without case, extension and signs); rename one")
        seen[key] = name


def found_images(capture: Capture) -> Capture:
    """Find images whose names differ from files in leading folders, Unicode form or ending; a DataError if none is."""
    there = {frame.name for frame in capture.frames if is_inside(frame.name) and os.path.isfile(frame.image)}
    if len(there) == len(capture.frames):
        return capture
    folder = next(folder for folder in (capture.image_folder, *capture.image_folder.parents) if folder.is_dir())
    if folder == capture.folder and not there:
        folder = image_folder(folder, None)
    meant: dict[str, set[str]] = {}
    ends: dict[str, set[str]] = {}  # end of a file's path, with and without extension -> files
    for file in image_names(folder):
        whole, *without = spellings(file)
        for key in (whole, *without[:1]):
            meant.setdefault(key.casefold(), set()).add(file)
        for key in without if capture.format == "metashape" and not _is_beside(file) else ():
            ends.setdefault(key.casefold(), set()).add(file)
    found = {}  # stated name -> file
    for name in (frame.name for frame in capture.frames if frame.name not in there):
        files = next((meant[key] for key in spellings(name.casefold()) if key in meant), set())
        if not files and not there and "/" not in name:  # labels, which state no folder
            files = next((ends[key] for key in [*spellings(name.casefold())][:2] if key in ends), set())
        if len(files) > 1:
            way_out = "remove all but one, set data.images to its folder, or name it with folder and extension"
            raise DataError(f"{name!r} of the {capture.format} data set may be {listed(sorted(files))}; {way_out}")
        if files:
            (found[name],) = files
    taken = Counter([*found.values(), *there])
    found = {name: file for name, file in found.items() if taken[file] == 1}
    for frame in capture.frames:
        if frame.name not in found and not is_inside(frame.name):
            raise DataError(
                f"the {capture.format} data set {capture.folder} names {frame.name!r}; names must be relative and stay "
                f"inside the image folder (no '..'), or end like one image in {folder}: remove the leading folders, "
                "or set data.images"
            )
    if not found:
        return capture
    stated, file = next(iter(found.items()))
    note = (
        f"images: {len(found)} names differ from their files in folders, extension, case or Unicode form: "
        f"{stated!r} is {os.path.relpath(folder / file, capture.folder)}"
    )
    names = {frame.name: found.get(frame.name, frame.name) for frame in capture.frames}
    frames = (replace(frame, name=names[frame.name], image=folder / names[frame.name]) for frame in capture.frames)
    split = capture.split and {
        side: tuple(names.get(name, name) for name in listed_names) for side, listed_names in capture.split.items()
    }
    return replace(capture, image_folder=folder, frames=tuple(frames), split=split, notes=(*capture.notes, note))


def _is_beside(file: str) -> bool:
    """Return whether a file is by its folder a mask or a depth map, and no photograph."""
    return is_of_masks(file) or bool({*PurePosixPath(file).parts[:-1]} & {*DEPTH_FOLDERS})


def _without_unlisted(capture: Capture, options: DataOptions) -> Capture:
    """Leave out frames without an image, with a note, if they are in neither list of views."""
    names, there = [frame.name for frame in capture.frames], [frame.image.is_file() for frame in capture.frames]
    if all(there) or options.split in ("every", "all"):
        return capture
    split = split_frames(names, *capture.places, mode=options.split, every=options.test_every, stated=capture.split)
    kept = [there[i] or i in split.train or i in split.test for i in range(len(names))]
    if not (lost := [name for name, is_kept in zip(names, kept, strict=True) if not is_kept]):
        return capture
    note = f"{len(lost)} poses without an image are in neither list and are not used: {listed(lost)}"
    return replace(capture, frames=tuple(compress(capture.frames, kept)), notes=(*capture.notes, note))


def _refuse_missing(capture: Capture) -> None:
    absent = [frame.name for frame in capture.frames if not frame.image.is_file()]
    if not absent:
        return
    unreadable = next((name for name in image_names(capture.image_folder) if name in absent), None)
    remedy = "set data.images to the folder that holds them, or name the others in train.txt and test.txt"
    last_names = {PurePosixPath(name).stem for name in absent}
    photographs = [name for name in image_names(capture.folder) if not _is_beside(name)]
    elsewhere = next((name for name in photographs if PurePosixPath(name).stem in last_names), None)
    above = [image_folder(folder, None) for folder in list(capture.folder.absolute().parents)[:3]]
    if outside := next((folder for folder in above if (folder / absent[0]).is_file()), None):
        remedy = f"set data.images to {os.path.relpath(outside, capture.folder)}, which holds {absent[0]}"
    if unreadable:
        remedy = f"{unreadable!r} is a pipe, a device or a broken link: put the image in its place"
    elif elsewhere:
        remedy = f"{capture.folder / elsewhere} has the name of one: set data.images to the folder that holds them"
    lost = f"{len(absent)} of {len(capture.frames)} poses have no image in {capture.image_folder}"
    raise DataError(f"{lost}: {listed(absent)}; {remedy}")


def _camera_notes(frames: Sequence[Frame], images: Sequence[ImageFile]) -> list[str]:
    """Check that all panoramas of a camera have its size, or differ from it by one common factor."""
    scales: dict[tuple[int, int], dict[float, str]] = {}  # stated size -> factor -> sizes in words
    for frame, image in zip(frames, images, strict=True):
        if frame.width is None or frame.height is None:
            continue
        text = f"{image.path} is {image.width}x{image.height}, its camera {frame.width}x{frame.height}"
        part = image.crop if frame.lens is None else None
        if part is not None and abs(frame.width - part.width) <= 1 and part.width < image.width:
            way_out = "run padgs prepare on the images, or remove their GPano tags if those are wrong"
            raise DataError(f"{text}, which takes a part of a panorama for the whole; {way_out}")
        if min(frame.width, frame.height) < 1 or (frame.lens is None and frame.width != 2 * frame.height):
            rule = "a full panorama is 2:1" if frame.lens is None else "a camera has pixels"
            raise DataError(f"the camera of {frame.name} is {frame.width}x{frame.height}; {rule}: correct its size")
        if frame.lens is not None:
            if abs(image.width / frame.width - image.height / frame.height) > 0.01:
                raise DataError(f"{text}; make them agree")
            continue
        scales.setdefault((frame.width, frame.height), {}).setdefault(image.width / frame.width, text)
    for of_camera in scales.values():
        if len(of_camera) > 1:
            differ = "; but ".join(list(of_camera.values())[:2])
            raise DataError(f"images and cameras disagree in size: {differ}; make them agree")
    return [f"images: {text}; used as they are" for of in scales.values() for scale, text in of.items() if scale != 1]
