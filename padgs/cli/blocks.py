"""`padgs split` and `padgs merge`: a large capture as blocks that are trained one by one."""

from typing import Annotated

import typer

from padgs.cli.errors import Depth, Device, Format, Images, Mask, Points, Split, check_range, name_place, show


def split(
    source: Annotated[str, typer.Argument(help="folder with panoramas, poses and points")],
    blocks: Annotated[int, typer.Option(help="number of blocks")],
    to: Annotated[str, typer.Option(help="folder to write; default: SOURCE-blocks")] = "",
    format: Format = "auto",
    mask: Mask = "auto",
    images: Images = "",
    points: Points = "auto",
    depth: Depth = "auto",
    split: Split = "auto",
) -> None:
    """Divide a data set into blocks of cameras that see the same points; their images are links to those of SOURCE."""
    import os
    import shlex
    from pathlib import Path

    from padgs.apps.blocks import split as write
    from padgs.data.capture import DataOptions

    check_range(2, 10_000, blocks=blocks)
    destination = Path(to or f"{os.path.abspath(source)}-blocks")  # also of "."
    destination = destination.resolve() if destination.is_symlink() else destination  # a link may lead to a larger disk
    options = DataOptions(mask=mask, split=split, images=images or None, points=points, depth=depth)
    with name_place(destination):
        written, notes = write(Path(source), destination, blocks, format, options)
    show("\n".join(f"  {note}" for note in notes))
    for folder, content in written.items():
        show(f"{folder}: {content}")
    names = ",".join(f'"{folder}"' if "," in folder else folder for folder in map(str, written))
    command = shlex.join(["padgs-run", "-m", f"data.path={names}", *(["data.split=all"] if split == "all" else [])])
    show(f"next: {command}, then padgs merge with the runs")


def merge(
    runs: Annotated[list[str], typer.Argument(help="folders of the finished runs, one of each block")],
    data: Annotated[str, typer.Option(help="folder of the blocks, if it has moved since padgs split")] = "",
    device: Device = "auto",
) -> None:
    """Join the runs of all blocks into one run on the whole data set, scored on all its test views."""
    from rich.console import Console

    from padgs.apps.blocks import merge as join

    join(runs, Console(highlight=False, soft_wrap=True), data=data, device=device)
