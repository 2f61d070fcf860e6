"""`padgs convert`: write a data set in another format."""

from typing import Annotated

import typer

from padgs.cli.errors import OF_DATA, Depth, Images, Mask, Points, Split, as_options, check_range, show
from padgs.cli.prepare import CameraHeight, Gps, Metres

FORMATS = "colmap, nerfstudio (or transforms), openmvg, opensfm, released"
SOURCES = "metashape, e57, navvis, roam360, ricoh360, omniblender, ob3d, tartanair"  # besides


def convert(
    source: Annotated[str, typer.Argument(help="folder with panoramas and poses, or the file that describes them")],
    destination: Annotated[str, typer.Argument(help="a folder that does not exist yet")],
    to: Annotated[str, typer.Option(help=f"format to write: {FORMATS}")],
    format: Annotated[str, typer.Option(help=f"format of the source: auto, one of these, or {SOURCES}")] = "auto",
    width: Annotated[int, typer.Option(help="reduce the panoramas to this width; 0 copies them as they are")] = 0,
    points: Points = "auto",
    mask: Mask = "auto",
    depth: Depth = "auto",
    images: Images = "",
    split: Split = "auto",
    metres: Metres = None,
    camera_height: CameraHeight = None,
    gps: Gps = False,
) -> None:
    """Write a data set in another format. Exit code 1, and nothing written, if that is impossible."""
    from pathlib import Path

    from rich.console import Console

    from padgs.data.capture import DataOptions
    from padgs.data.formats.convert import convert as write
    from padgs.data.metres import KnownLength

    check_range(0, 65536, width=width)
    with Console().status("reading") as status:
        scene = write(
            Path(source),
            Path(destination),
            to,
            format=format,
            options=DataOptions(
                width=width or None, points=points, mask=mask, depth=depth, split=split, images=images or None
            ),
            known=KnownLength(metres, camera_height, gps),
            progress=lambda done, total: status.update(f"image {done} of {total}"),
        )
    for note in scene.notes:
        show(f"  {note if 'train on' in note else as_options(note, OF_DATA)}")  # training has no such options
    views = f"{len(scene.train)} train and {len(scene.test)} test views, {len(scene.points)} points"
    show(f"{destination}: {views}, as {to}")
