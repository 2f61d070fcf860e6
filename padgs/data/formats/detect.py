"""Which format a folder or file holds, and by what that was seen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from padgs.data.errors import DataError, listed
from padgs.data.formats.colmap import find_model

Sign = Callable[[Path], str | None]


def _has(*names: str) -> Sign:
    def sign(path: Path) -> str | None:
        return " and ".join(names) if all((path / name).exists() for name in names) else None

    return sign


def _file(name: str) -> Sign:
    def sign(path: Path) -> str | None:
        if path.is_file():
            return path.name if path.name == name else None
        return name if (path / name).is_file() else None

    return sign


def _colmap(path: Path) -> str | None:
    model = find_model(path) if path.is_dir() else None
    return None if model is None else f"the COLMAP model in {model.relative_to(path)}"


# Most specific first: the native folders of data sets also hold files of the general formats.
SIGNS: dict[str, tuple[Sign, ...]] = {
    "roam360": (_has("pose_c2w.json"),),
    "ricoh360": (_has("output_dir/colmap/images.txt"),),
    "released": (_has("data_extrinsics.json", "data_views.json"),),
    "colmap": (_colmap,),
    "omniblender": (_file("transform.json"),),
    "transforms": (_file("transforms.json"), _has("transforms_train.json")),
    "openmvg": (_file("sfm_data.json"),),
    "opensfm": (_file("reconstruction.json"),),
}


def detect(path: Path) -> tuple[str, str]:
    """The format of a data set, and the reason in words.

    Raises:
        DataError: nothing known is there; the message says what was looked for.

    """
    found = {name: sign for name, signs in SIGNS.items() for test in reversed(signs) if (sign := test(path))}
    if not found:
        inside = listed(sorted(child.name for child in path.iterdir())) if path.is_dir() else "a file"
        raise DataError(
            f"{path} has no known format; it holds {inside or 'nothing'}. Known are a COLMAP model (sparse/0), "
            "transforms.json, sfm_data.json, reconstruction.json, pose_c2w.json (360Roam), output_dir/colmap "
            "(Ricoh360), transform.json (OmniBlender), data_views.json with data_extrinsics.json. Panoramas without "
            "poses: run `padgs prepare IMAGES OUT` first"
        )
    name, *others = found
    reason = f"format: {name}, because there is {found[name]}"
    if others:
        reason += f" (also there, not used: {', '.join(found[other] for other in others)}; data.format chooses)"
    return name, reason
