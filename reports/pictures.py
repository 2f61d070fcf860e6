"""Pictures that runs left beside their results."""

from __future__ import annotations

from pathlib import Path

from PIL import Image


def picture_names(folder: Path | None) -> list[str]:
    """Those of the test views in the folder of a run, sorted; none in a store."""
    return [] if folder is None else sorted(path.name for path in folder.glob("*.png"))


def split(path: Path, count: int) -> list[Image.Image]:
    """So many parts of equal width that lie side by side in a picture.

    Raises:
        OSError: there is no such picture, or a kill has cut it.
    """
    with Image.open(path) as picture:
        picture.load()
        width = picture.width // count
        return [picture.crop((part * width, 0, (part + 1) * width, picture.height)) for part in range(count)]
