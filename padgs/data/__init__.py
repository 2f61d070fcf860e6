"""Data sources: panoramas with poses, read from any supported format into one `Scene`.

`load(path)` detects the format; `Scene.notes` says what was decided and why.
"""

import json
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path

from padgs.checks import lookup
from padgs.data.assemble import PREPARED, assemble, found_images
from padgs.data.capture import OTHERS, Capture, DataError, DataOptions
from padgs.data.cloud import NO_FILE, read_cloud
from padgs.data.conventions import best_reading
from padgs.data.datasets import DATASETS, lookup_dataset, refuse_missing
from padgs.data.formats import detect
from padgs.data.masks import mask_digests
from padgs.files import given_path
from padgs.scene import Scene

# `read(path, options) -> Capture`, except synthetic, which reads no files: `load(path, options) -> Scene`.
LOADERS = {
    "colmap": "padgs.data.formats.colmap:read",
    "transforms": "padgs.data.formats.transforms:read",
    "nerfstudio": "padgs.data.formats.transforms:read",  # an alias of transforms
    "openmvg": "padgs.data.formats.reconstructions:read_openmvg",
    "opensfm": "padgs.data.formats.reconstructions:read_opensfm",
    "metashape": "padgs.data.formats.metashape:read",
    "e57": "padgs.data.formats.scanners:read_e57",
    "navvis": "padgs.data.formats.scanners:read_navvis",
    "roam360": "padgs.data.formats.published:read_roam360",
    "ricoh360": "padgs.data.formats.published:read_ricoh360",
    "omniblender": "padgs.data.formats.published:read_omniblender",
    "ob3d": "padgs.data.formats.published:read_ob3d",
    "tartanair": "padgs.data.formats.published:read_tartanair",
    "released": "padgs.data.formats.reconstructions:read_released",
    "synthetic": "padgs.data.synthetic:load",
}
OUTSIDE = {point.name: point for point in entry_points(group="padgs.datasets") if point.name not in LOADERS}
LOADERS |= {name: point.value for name, point in OUTSIDE.items()}  # readers of other packages

__all__ = ["DATASETS", "LOADERS", "DataError", "DataOptions", "load", "read"]


def load(
    path: str | Path | None = None,
    format: str = "auto",
    options: DataOptions = DataOptions(),  # noqa: B008 - frozen dataclass
    **fields: object,
) -> Scene:
    """Load the scene of a data set; unusable input is a DataError, an unknown format a ValueError.

    Args:
        path: the data set's folder, or the file that describes it; None generates a room.
        format: a name of `LOADERS`, or auto.
        options: the `data` group of the configuration.
        fields: single options by name; they override `options`.
    """
    options = replace(options, **fields)
    if path is None and options.dataset is not None:
        scene = lookup_dataset(options.dataset).scenes[0]
        raise DataError(
            f"data.dataset is {options.dataset}, but data.path is not set; set it to the folder of a scene, or choose "
            f"one by name, e.g. +scene={options.dataset}_{scene}"
        )
    if format == "synthetic" or (path is None and format == "auto"):
        return lookup(LOADERS, "synthetic", "data.format")(path or "", options)
    return assemble(read(path or "", format, options), options)


def read(path: str | Path, format: str = "auto", options: DataOptions = DataOptions()) -> Capture:  # noqa: B008
    """Read poses, points and split lists of a data set, but no images; for `padgs convert` and `padgs check`."""
    path = Path(path)
    refuse_missing(path, options.dataset)
    notes: tuple[str, ...] = ()
    if format == "auto":
        format, reason = detect(path)
        notes = (reason,)
    elif format in OUTSIDE:
        package = OUTSIDE[format].dist
        notes = (f"format: {format}, read by {package.name} {package.version}",) if package else ()
    if format == "synthetic":
        raise DataError(f"{path}: synthetic scenes are made, not read from a folder; give another format, or auto")
    reader = lookup(LOADERS, format, "data.format")
    try:
        capture = reader(path, options)
    except DataError as error:
        if not any(OTHERS in note for note in notes):
            raise
        raise DataError("; ".join((str(error), *notes))) from error
    if not isinstance(capture, Capture):
        raise ValueError(f"{LOADERS[format]} returned {type(capture).__name__}; a reader returns a Capture")
    mask = capture.mask if options.dataset is None else lookup_dataset(options.dataset).mask
    if mask == "auto":
        mask = next(filter(None, map(_prepared_mask, capture.places)), mask)
    capture = replace(capture, mask=mask, notes=(*notes, *capture.notes))
    if options.points != "auto" and any(not one.axes.equal(capture.readings[0].axes) for one in capture.readings):
        with suppress(DataError):  # if its own points cannot be read, nothing says how its images are turned
            own = best_reading(found_images(reader(path, replace(options, points="auto"))))
            capture = replace(capture, frames=own.frames, notes=(*notes, *own.notes), readings=())
    if options.points not in NO_FILE:  # before its frame is chosen; tracks belong to the capture's own points
        cloud, notes = read_cloud(given_path(options.points, capture.folder))
        capture = replace(capture, cloud=cloud, tracks=None, notes=(*capture.notes, *notes))
    return best_reading(found_images(capture))


def _prepared_mask(folder: Path) -> str | None:
    """Return the mask file or folder that `padgs prepare` wrote, if unchanged: it may hide most, as of narrow crops."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        written = json.loads((folder / PREPARED).read_text(encoding="utf-8"))["masks"]
        return next(iter(written)).partition("/")[0] if written and written == mask_digests(folder) else None
