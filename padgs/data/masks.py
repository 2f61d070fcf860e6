"""Masks: weights of pixels, 255 = use, 0 = ignore. Images themselves are never blackened.

A mask is one file for the scene, one file per image, the rule that only the first rows count, or their product.
`data.mask=inverted` (or inverted:FOLDER) reads files in which 255 marks what to ignore.
"""

import hashlib
import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from statistics import median

import torch
from torch import Tensor

from padgs.data.capture import Capture, DataError, first_of, listed
from padgs.data.image_metadata import Crop
from padgs.data.images import EXTENSIONS, ImageFile, inspect, read_bytes, save_png
from padgs.data.store import ImageStore, StoredImage
from padgs.files import folded, given_path
from padgs.geometry.distortion import solid_angle_weight

SCENE_MASKS = ("mask.png", *(f"mask{extension}" for extension in EXTENSIONS))
MASK_FOLDERS = ("masks", "mask")
MIN_VISIBLE = 0.01  # of the sphere; with less, training has no signal and metrics are undefined
MAX_HIDDEN = 0.75  # share of the sphere that a sound mask hides at most: tripod, sky, what a part of a panorama lacks
INVERTED = "dynamic_mask_"  # begins the names of instant-ngp's masks, in which 255 marks what to ignore
_ROWS = re.compile(r"rows:(\d+)/(\d+)")
_MEANING = "in a mask 255 means use, 0 means ignore. If white marks what to ignore in them, set data.mask=inverted"


@dataclass(frozen=True)
class Mask:
    """Weights of one view; used as `View.load_mask`."""

    file: StoredImage | None
    fixed: Tensor | None  # [H, W or 1] float32, of `rows:` and of crops
    inverted: bool = False  # whether 255 means ignore in the file
    hidden: float = 0.0  # share that the file hides of what the picture, maybe a part of a panorama, shows

    def __call__(self) -> Tensor:
        """Return weights [H, W] float32 in [0, 1]."""
        if self.file is None:
            assert self.fixed is not None
            return self.fixed.expand(-1, 2 * len(self.fixed)).clone()
        weight = self.file()[..., 0].float() / 255
        weight = 1 - weight if self.inverted else weight
        return weight if self.fixed is None else weight * self.fixed.to(weight.device)


def row_weights(keep: float, of: float, height: int) -> Tensor:
    """Return weights [height, 1] that keep the first `keep` of `of` rows, at any height.

    A row that the border cuts has a fractional weight, as if image and mask had been reduced together.
    """
    return (keep / of * height - torch.arange(height, dtype=torch.float64)).clamp(0, 1).float()[:, None]


def crop_weights(crop: Crop, width: int, height: int) -> Tensor:
    """Return weights [height, width]: 1 where a pixel shows nothing but the crop, else 0."""

    def inside(start: int, size: int, full: int, count: int) -> Tensor:
        edges = torch.arange(count + 1, dtype=torch.float64) * full / count
        return ((edges[:-1] > start - 1e-6) & (edges[1:] < start + size + 1e-6)).float()

    rows = inside(crop.top, crop.height, crop.full_height, height)
    return rows[:, None] * inside(crop.left, crop.width, crop.full_width, width)


def find_masks(
    capture: Capture, spec: str, images: Sequence[ImageFile], sizes: Sequence[tuple[int, int]], store: ImageStore
) -> tuple[list[Mask | None], list[str], list[str]]:
    """Return the mask of each frame, the digests of the mask files, and notes.

    `spec` is `data.mask`, see `mask_path`; `images` are the files of the frames, `sizes` (width, height) of the views;
    `store` caches decoded masks. A DataError says that a mask differs in size from its image, shows less than
    `MIN_VISIBLE`, or has transparent pixels; that masks which `spec` does not name hide more than `MAX_HIDDEN`, as
    inverted ones do; or that `spec` is invalid.
    """
    spec = capture.mask if spec == "auto" else spec
    inverted, given = spec == "inverted" or spec.startswith("inverted:"), spec
    spec = (spec.removeprefix("inverted").removeprefix(":") or "auto") if inverted else spec
    rule = _ROWS.fullmatch(spec)
    stated = (place / spec for place in capture.places if given == capture.mask)  # by the data set, so in its folders
    path = next(filter(Path.exists, stated), None) or mask_path(spec, *capture.places)
    files, note = ({}, None) if spec == "none" else _mask_files(capture, path)
    if inverted and not files:
        raise DataError(f"data.mask={given}: there are no mask files to invert; put them in {capture.places[-1]}/masks")
    notes = [note] if note else []
    rows: dict[int, Tensor] = {}  # by height
    if rule:
        keep, of = int(rule[1]), int(rule[2])
        if not 0 < keep <= of:
            raise DataError(f"data.mask={spec}: the first number is how many of the second are kept; 1 to {of}")
        notes.append(f"mask: rows from {keep} of {of} on are ignored ({1 - keep / of:.1%} of the image)")
        rows = {height: row_weights(keep, of, height) for _, height in sizes}
        for weights in rows.values():
            _refuse_hidden(weights, f"data.mask={spec} hides ", " of each image; keep more rows")
    masks: list[Mask | None] = []
    digests = [spec] if rule else []
    inspected: dict[tuple[Path, Crop | None], ImageFile] = {}
    shown: dict[StoredImage | None, float] = {}  # share of what the picture shows
    for frame, image, (width, height) in zip(capture.frames, images, sizes, strict=True):
        path, fixed, pictured = files.get(frame.name), rows.get(height) if frame.lens is None else None, 1.0
        if image.crop is not None:
            fixed = crop_weights(image.crop, width, height) * (1 if fixed is None else fixed)
            pictured = _refuse_hidden(fixed, f"the crop of {image.path} hides ", "; remove that image")
        if path is None:
            masks.append(None if fixed is None else Mask(None, fixed))
            continue
        if (key := (path, image.crop)) not in inspected:
            inspected[key] = inspect(path, mask=True, panorama=frame.lens is None, within=image.crop)
        mask_file = inspected[key]
        is_reduced = frame.lens is None and mask_file.width >= width  # of the view; all panoramas have one shape
        if not is_reduced and (mask_file.width, mask_file.height) not in ((image.width, image.height), (width, height)):
            sizes_differ = f"{mask_file.width}x{mask_file.height} but {image.path.name} is {image.width}x{image.height}"
            rule = "a mask must have the size of its image, or be no smaller than the view"
            raise DataError(f"{path} is {sizes_differ}; {rule} ({width}x{height}, data.width): enlarge it")
        stored = StoredImage(path, width, height, store, "L", image.crop)
        mask = Mask(stored, fixed, inverted or path.name.startswith(INVERTED))
        if mask.file not in shown:
            rule = f" of {frame.name}; {_MEANING}"
            shown[mask.file] = _refuse_hidden(mask(), f"{path} hides ", rule) / pictured
        masks.append(replace(mask, hidden=1 - shown[mask.file]))
        digests.append(f"{frame.name}:{mask_file.digest}{':inverted' * mask.inverted}")
    if shown and (hidden := 1 - median(shown.values())) > MAX_HIDDEN:
        hides = f"the masks hide {hidden:.0%} of the sphere"
        if given == "auto":
            paths = [path for path, _ in inspected]
            where = min((os.path.relpath(paths[0], place) for place in capture.places), key=len).split(os.sep)[0]
            names = listed(path.name for path in paths)
            raise DataError(f"{hides}, in {names}; {_MEANING}; if that is meant, set data.mask={where}")
        notes.append(f"{hides}, as data.mask={given} says")
    return masks, digests, notes


def mask_path(spec: str, *folders: Path) -> Path | None:
    """Return the file or folder that `data.mask` names; None for a keyword.

    Relative paths are looked up in the folders of the data set and in the working one; two that differ are a DataError.
    """
    if spec in ("auto", "none", "inverted") or _ROWS.fullmatch(spec):
        return None
    folder = next((folder for folder in folders if (folder / spec).exists()), folders[0])
    inside, here = folder / spec, Path(spec).absolute()
    if here.exists() and inside.exists() and not inside.samefile(here):
        raise DataError(f"data.mask={spec} is both {inside} and {here}; give the absolute path of one")
    return given_path(spec, folder)


def _refuse_hidden(weights: Tensor, what: str, way_out: str) -> float:
    """Return the share of the sphere that weights [H, W or 1] show; refuse less than `MIN_VISIBLE`.

    The message says how much is hidden between `what` and `way_out`.
    """
    area = solid_angle_weight(len(weights))
    # The mean weight, not the share of non-zero pixels: a mask with 1 in place of 255 hides nearly everything.
    shown = (weights.mean(-1).cpu() @ area / area.sum()).item()
    if shown < MIN_VISIBLE:
        much = f"all but {shown:.2%} of the sphere" if shown else "every pixel"
        raise DataError(what + much + way_out)
    return shown


def _mask_files(capture: Capture, given: Path | None) -> tuple[dict[str, Path], str | None]:
    """Map frame names to mask files (one for all, a folder of files, or files that the format names); and a note."""
    if given is not None and not given.exists():
        raise DataError(f"data.mask={given}: no such file or folder; keywords: auto, none, inverted, rows:959/1024")
    named = {frame.name: frame.mask for frame in capture.frames if frame.mask is not None}
    if given is None and named:
        if absent := [path for path in named.values() if not path.is_file()]:
            raise DataError(f"the mask {absent[0]} that {capture.format} names does not exist; set data.mask=none")
        return named, f"masks: those that {capture.format} names, for {len(named)} of {len(capture.frames)} views"
    if given is None:
        kinds = ((SCENE_MASKS, Path.is_file), (MASK_FOLDERS, _holds_any))
        places = (first_of(place, names, kind) for place in capture.places for names, kind in kinds)
        inner = first_of(capture.image_folder, MASK_FOLDERS, _holds_any)
        given = next(filter(None, (*places, inner)), capture.image_folder)
    if given.is_file():
        panoramas = [frame.name for frame in capture.frames if frame.lens is None]
        which = "every view" if len(panoramas) == len(capture.frames) else "every panorama"
        beside = first_of(given.parent, MASK_FOLDERS, _holds_any) if given.parent in capture.places else None
        unused = f"; {beside.name}/ is not used (data.mask={beside.name} uses it)" if beside else ""
        return dict.fromkeys(panoramas, given), f"mask: {given.name} for {which}{unused}"
    beside, files = given == capture.image_folder, dict[str, Path]()
    deepest = max(len(PurePosixPath(frame.name).parts) for frame in capture.frames)
    for folder, folders, names in os.walk(given, followlinks=True):
        inside = Path(folder).relative_to(given)
        if len(inside.parts) >= deepest:  # in masks/ beside the deepest image; links may go round in circles
            folders.clear()
        files |= {folded(inside / name): Path(folder, name) for name in names}
    ends = Counter(folded(PurePosixPath(frame.name).stem) for frame in capture.frames)
    found = {frame.name: path for frame in capture.frames if (path := _in_folder(files, frame.name, beside, ends))}
    if beside and not found:
        around = [path for place in capture.places for path in sorted(place.glob("*"))]
        others = [path.name for path in around if re.search("mask|segm", path.name, re.I)]
        return {}, f"masks: not used: {listed(others)}; name one with data.mask" if others else None
    if not found:
        such = f"named like an image (such as {capture.frames[0].name}.png)"
        raise DataError(f"{given} holds no mask {such}; rename them, or set data.mask=none")
    turned = " (white is ignored)" if any(path.name.startswith(INVERTED) for path in found.values()) else ""
    others = sorted({*given.glob("*")} - {*found.values()}) if len(found) < len(capture.frames) else []
    left = [path.name for path in others if path.suffix.lower() in EXTENSIONS]
    if given.parent in capture.places:
        there = (first_of(given.parent, (name,), _holds_any) for name in MASK_FOLDERS)
        left += [f"{folder.name}/" for folder in there if folder not in (given, None)]
    rest = f"; not used: {listed(left)}" if left and not beside else ""
    return found, f"masks: {given.name}/ for {len(found)} of {len(capture.frames)} views{turned}{rest}"


def _holds_any(folder: Path) -> bool:
    return folder.is_dir() and not all(path.name.startswith(".") for path in folder.iterdir())


def masks_beside(name: str) -> list[str]:
    """Return the names that a mask may have beside its image, or in a folder of masks there.

    >>> {"hall/a.jpg.png", "hall/mask_a.bmp", "hall/masks/a.png"} <= {*masks_beside("hall/a.jpg")}
    True
    """
    file, stem = (path := PurePosixPath(name)).name, path.stem
    stems = [f"{stem}_mask", f"{stem}.mask", f"{stem}-mask", f"mask_{stem}", f"mask-{stem}"]
    names = [f"{file}.png", f"{file}.mask.png", f"{INVERTED}{stem}.png"]
    names += [f"{named}{extension}" for named in stems for extension in EXTENSIONS]
    inside = [*names, *(f"{stem}{extension}" for extension in (".png", *EXTENSIONS))]
    folder = name.removesuffix(file)
    return [folder + end for end in [*names, *(f"{place}/{end}" for place in MASK_FOLDERS for end in inside)]]


def is_of_masks(name: str) -> bool:
    """Return whether a file lies in a folder that is named for masks, by its path relative to that of the images.

    >>> is_of_masks("hall/Masks/a.png"), is_of_masks("sky_masks/a.png"), is_of_masks("hall/mask.png")
    (True, True, False)
    """
    return any(re.search(r"(?i)(?<![a-z])masks?(?![a-z])", part) for part in PurePosixPath(name).parts[:-1])


def _in_folder(files: Mapping[str, Path], name: str, beside: bool, ends: Mapping[str, int]) -> Path | None:
    """Return the mask of an image among files by folded path, or by its last name if that is unique (counts `ends`)."""
    stem = PurePosixPath(name).with_suffix("")
    first, *others = masks_beside(name)
    for candidate in [first, *([] if beside else [f"{stem}{end}" for end in (".png", *EXTENSIONS)]), *others]:
        if (file := files.get(folded(candidate))) and file.is_file():
            return file
    is_alone = not beside and "/" in name and ends[folded(stem.name)] == 1
    return _in_folder(files, PurePosixPath(name).name, beside, ends) if is_alone else None


def mask_digests(folder: Path) -> dict[str, str]:
    """Return the digests of mask.png, else of the masks in masks/, by their paths in a folder."""
    scene, inside = folder / SCENE_MASKS[0], sorted((folder / MASK_FOLDERS[0]).rglob("*"))
    files = [scene] if scene.is_file() else [path for path in inside if path.suffix.lower() in EXTENSIONS]
    return {path.relative_to(folder).as_posix(): hashlib.sha256(read_bytes(path)).hexdigest() for path in files}


def write_masks(masks: Mapping[str, Callable[[], Tensor] | None], folder: Path) -> None:
    """Write mask.png if all views share a mask, else masks/ with a file per masked view; `masks` load their weights."""
    loaders = {name: load for name, load in masks.items() if load is not None}
    if loaders and len(loaders) == len(masks):
        first, *others = loaders.values()
        mask = first()
        if all(load().equal(mask) for load in others):
            save_png(mask * 255, folder / "mask.png")
            return
    for name, load in loaders.items():
        save_png(load() * 255, folder / "masks" / f"{name}.png")
