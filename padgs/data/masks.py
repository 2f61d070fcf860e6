"""Masks: which pixels count. 255 = use, 0 = ignore; never a reason to blacken an image.

A mask is one file for the scene, one file per image, the rule that only the first rows count, or their product.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import torch
from torch import Tensor

from padgs.data.capture import Capture, DataError
from padgs.data.images import EXTENSIONS, ImageFile, inspect, save_png
from padgs.data.store import ImageStore, StoredImage
from padgs.geometry.distortion import solid_angle_weight

SCENE_MASKS = ("mask.png", "mask.jpg", "mask.bmp")
PREVIEW = "mask_preview.jpg"  # beside them, of `padgs.data.prepare.nadir`
LEAST = 0.01  # of the sphere must be seen; from less nothing is learned, and no metric has a value
_ROWS = re.compile(r"rows:(\d+)/(\d+)")


@dataclass(frozen=True)
class Mask:
    """The weights of one view: what `View.load_mask` is."""

    file: StoredImage | None
    rows: Tensor | None  # [H, 1] float32

    def __call__(self) -> Tensor:
        """Weights [H, W] float32 in [0, 1]."""
        weight = None if self.file is None else self.file()[..., 0].float() / 255
        if self.rows is None:
            assert weight is not None
            return weight
        rows = self.rows if weight is None else self.rows.to(weight.device)
        return rows.expand(-1, 2 * len(rows)).clone() if weight is None else weight * rows


def row_weights(keep: float, of: float, height: int) -> Tensor:
    """Weights [height, 1] of the rule "only the first `keep` of `of` rows count", at any height.

    A row that the border cuts counts by its share, so that reducing the image and its mask agree.

    >>> row_weights(959, 1024, 1024).sum().item()
    959.0
    """
    return (keep / of * height - torch.arange(height, dtype=torch.float64)).clamp(0, 1).float()[:, None]


def find_masks(
    capture: Capture, spec: str, images: Sequence[ImageFile], sizes: Sequence[tuple[int, int]], store: ImageStore
) -> tuple[list[Mask | None], list[str], list[str]]:
    """The mask of each frame, the digests of the files used, and notes.

    Args:
        capture: the frames, and the folder in which masks are looked for.
        spec: `data.mask`; see `mask_place`.
        images: the files of the frames.
        sizes: (width, height) of the views.
        store: where decoded masks are kept.

    Raises:
        DataError: a mask of another size than its image, one that hides all but `LEAST` or has transparent pixels, or
            an unusable `spec`.
    """
    spec = capture.mask if spec == "auto" else spec
    if spec == "none":
        return [None] * len(images), [], []
    rule = _ROWS.fullmatch(spec)
    files, note = _mask_files(capture, mask_place(spec, capture.folder))
    notes = [note] if note else []
    rows: dict[int, Tensor] = {}  # by height
    if rule:
        keep, of = int(rule[1]), int(rule[2])
        if not 0 < keep <= of:
            raise DataError(f"data.mask={spec}: the first number is how many of the second are kept; 1 to {of}")
        notes.append(f"mask: rows from {keep} of {of} on are ignored ({1 - keep / of:.1%} of the image)")
        rows = {height: row_weights(keep, of, height) for _, height in sizes}
        for weights in rows.values():
            _refuse_hidden(weights, f"data.mask={spec} hides {{}} of each image; keep more rows")
    masks: list[Mask | None] = []
    digests = [spec] if rule else []
    inspected: dict[Path, ImageFile] = {}
    shown: set[StoredImage | None] = set()  # that are known to show something
    for frame, image, (width, height) in zip(capture.frames, images, sizes, strict=True):
        path = files.get(frame.name)
        if path is None:
            masks.append(Mask(None, rows[height]) if rule else None)
            continue
        if path not in inspected:
            inspected[path] = inspect(path, mask=True)
        mask_file = inspected[path]
        if (mask_file.width, mask_file.height) not in ((image.width, image.height), (width, height)):
            raise DataError(
                f"{path} is {mask_file.width}x{mask_file.height} but {image.path.name} is "
                f"{image.width}x{image.height}; a mask must have the size of its image"
            )
        mask = Mask(StoredImage(path, width, height, store, "L"), rows.get(height))
        if mask.file not in shown:
            _refuse_hidden(mask(), f"{path} hides {{}} of {frame.name}; in a mask 255 means use, 0 means ignore")
        shown.add(mask.file)
        masks.append(mask)
        digests.append(f"{frame.name}:{mask_file.digest}")
    return masks, digests, notes


def mask_place(spec: str, folder: Path) -> Path | None:
    """The file or folder that `data.mask` names, in the folder of the data set or where one stands; None for a word.

    Raises:
        DataError: there is one in both.
    """
    if spec in ("auto", "none") or _ROWS.fullmatch(spec):
        return None
    there, here = folder / spec, Path(spec).absolute()
    if not here.exists():
        return there
    if there.exists() and not there.samefile(here):
        raise DataError(f"data.mask={spec} is {there} as well as {here}; give the whole path of the one that is meant")
    return here


def _refuse_hidden(weights: Tensor, message: str) -> None:
    """Refuse weights [H, W or 1] that let next to nothing of the sphere through, with how much they hide."""
    area = solid_angle_weight(len(weights))
    # The mean weight, not the share of pixels that have any: 1 for "use" in place of 255 would hide nearly all.
    shown = (weights.mean(-1).cpu() @ area / area.sum()).item()
    if shown < LEAST:
        much = f"all but {shown:.2%} of the sphere" if shown else "every pixel"
        raise DataError(message.format(much))


def _mask_files(capture: Capture, given: Path | None) -> tuple[dict[str, Path], str | None]:
    """Frame name -> mask file, and a note: one file for all, a folder of files, or those that the format names."""
    if given is not None and not given.exists():
        raise DataError(f"data.mask={given}: there is no such file or folder; known words: auto, none, rows:959/1024")
    named = {frame.name: frame.mask for frame in capture.frames if frame.mask is not None}
    if given is None and named:
        absent = [path for path in named.values() if not path.is_file()]
        if absent:
            raise DataError(
                f"the mask {absent[0]} that {capture.format} names does not exist; set data.mask=none to do without"
            )
        return named, f"masks: those that {capture.format} names, for {len(named)} of {len(capture.frames)} views"
    if given is None:
        given = next((capture.folder / file for file in SCENE_MASKS if (capture.folder / file).is_file()), None)
        if given is None and (capture.folder / "masks").is_dir():
            given = capture.folder / "masks"
    if given is None:
        return {}, None
    if given.is_file():
        return {frame.name: given for frame in capture.frames}, f"mask: {given.name} for every view"
    found = {frame.name: path for frame in capture.frames if (path := _in_folder(given, frame.name)) is not None}
    if not found:
        raise DataError(f"{given} holds no mask named like an image (such as {capture.frames[0].name}.png)")
    return found, f"masks: {given.name}/ for {len(found)} of {len(capture.frames)} views"


def _in_folder(folder: Path, name: str) -> Path | None:
    """`a.jpg` has its mask in `a.jpg.png` (COLMAP's habit), `a.png` or another image named `a`."""
    stem = PurePosixPath(name).with_suffix("")
    candidates = [f"{name}.png", *(f"{stem}{extension}" for extension in (".png", *EXTENSIONS))]
    return next((folder / file for file in candidates if (folder / file).is_file()), None)


def write_masks(masks: Mapping[str, Callable[[], Tensor] | None], folder: Path) -> None:
    """mask.png if all views (name -> what loads its weights [H, W]) have the same, else masks/, a file per masked view.

    No more than two of them are in memory: all, as float32, would take more than the panoramas.
    """
    loaders = {name: load for name, load in masks.items() if load is not None}
    if loaders and len(loaders) == len(masks):
        first, *others = loaders.values()
        mask = first()
        if all(load().equal(mask) for load in others):
            save_png(mask * 255, folder / "mask.png")
            return
    for name, load in loaders.items():
        save_png(load() * 255, folder / "masks" / f"{name}.png")
