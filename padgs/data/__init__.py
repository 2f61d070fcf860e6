"""Data sources: panoramas with poses, from the formats people have, as one `Scene`.

`load(path)` looks at the folder, decides, and says in `Scene.notes` what it decided and why.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from padgs.data.capture import Capture
from padgs.data.datasets import DATASETS, lookup_dataset, refuse_missing
from padgs.data.errors import DataError
from padgs.data.formats.detect import detect
from padgs.data.options import DataOptions
from padgs.registry import lookup
from padgs.scene import Scene

# Each is `load(path, options) -> Scene`. All but synthetic read files; their modules also have `read`, to a Capture.
LOADERS = {
    "colmap": "padgs.data.formats.colmap:load",
    "transforms": "padgs.data.formats.transforms:load",
    "openmvg": "padgs.data.formats.openmvg:load",
    "opensfm": "padgs.data.formats.opensfm:load",
    "roam360": "padgs.data.formats.roam360:load",
    "ricoh360": "padgs.data.formats.ricoh360:load",
    "omniblender": "padgs.data.formats.omniblender:load",
    "released": "padgs.data.formats.released:load",
    "synthetic": "padgs.data.synthetic:load",
}

__all__ = ["DATASETS", "LOADERS", "DataError", "DataOptions", "load", "read"]


def load(
    path: str | Path | None = None,
    format: str = "auto",
    options: DataOptions = DataOptions(),  # noqa: B008 - frozen dataclass
    **fields: object,
) -> Scene:
    """The scene in a folder.

    Args:
        path: the data set's folder, or the file that describes it; without one, the built-in room is made.
        format: a name of `LOADERS`, or auto.
        options: the `data` group of the configuration.
        fields: single options by name, over `options`.

    Raises:
        DataError: input that cannot be used; the message names the file, the rule and the way out.
        ValueError: unknown format.
    """
    options = replace(options, **fields)  # type: ignore[arg-type]
    if path is None or format == "synthetic":
        return lookup(LOADERS, "synthetic" if format == "auto" else format, "data.format")(path or "", options)
    path, format, options, notes = _decide(Path(path), format, options)
    scene: Scene = lookup(LOADERS, format, "data.format")(path, options)
    return replace(scene, notes=(*notes, *scene.notes))


def read(path: str | Path, format: str = "auto", options: DataOptions = DataOptions()) -> Capture:  # noqa: B008
    """What a folder holds, images unread: the half of `load` that `padgs convert` and `padgs check` need."""
    path, format, options, notes = _decide(Path(path), format, options)
    readers = {name: entry.replace(":load", ":read") for name, entry in LOADERS.items() if name != "synthetic"}
    capture: Capture = lookup(readers, format, "data.format")(path, options)
    return replace(capture, notes=(*notes, *capture.notes))


def _decide(path: Path, format: str, options: DataOptions) -> tuple[Path, str, DataOptions, tuple[str, ...]]:
    refuse_missing(path, options.dataset)
    notes = ()
    if format == "auto":
        format, reason = detect(path)
        notes = (reason,)
    if options.dataset is not None and options.mask == "auto":
        options = replace(options, mask=lookup_dataset(options.dataset).mask)
    return path, format, options, notes
