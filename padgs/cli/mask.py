"""`padgs mask`: hide tripod and photographer below the camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from padgs.cli.errors import show


def mask(
    folder: Annotated[str, typer.Argument(help="folder of panoramas, or of a data set")],
    below: Annotated[float, typer.Option(help="hide everything more degrees below the horizon; try 60")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the mask that is there")] = False,
) -> None:
    """Write a mask of the region below the camera, and a preview; prepare, check and training find it."""
    from padgs.data.prepare.nadir import write_nadir_mask

    written = write_nadir_mask(Path(folder), below, overwrite=overwrite)
    show(f"{written.mask} for {written.images} panoramas; {written.preview} shows the masked region in red")
