"""`padgs export`: a run as a file that other programs open."""

from typing import Annotated

import typer

from padgs.cli.errors import DataPath, Device, Run, check_range, name_place, printable, show


def export(
    run: Run,
    to: Annotated[str, typer.Option(help="file to write; .ply, .compressed.ply, .spz, .sog, .glb or .html")] = "",
    upright: Annotated[bool, typer.Option("--upright", help="turn a .ply as all others: -y is up in viewers")] = False,
    smooth: Annotated[bool, typer.Option("--smooth", help="include the 3D filter of padgs+, as .html does")] = False,
    distillation_steps: Annotated[int | None, typer.Option(help="iterations of a fit to renders; default 300")] = None,
    crop: Annotated[str, typer.Option(help="box to keep: lowest and highest x y z, as padgs view shows them")] = "",
    data: DataPath = None,
    device: Device = "auto",
) -> None:
    """Write a run's Gaussians, by default into its folder as splats.ply.

    The Gaussians of PaD-GS differ from view to view, so they are baked into explicit ones; the loss is measured,
    printed and written into the file. Viewers that come nearer than the cameras, or have smaller pixels, show thin
    Gaussians as needles; --smooth writes none of padgs+ thinner than a pixel of the nearest photograph, and changes
    no method without a 3D filter. Formats other than .ply are made by splat-transform
    (npm install -g @playcanvas/splat-transform); .sog and .html can take minutes.
    """
    from pathlib import Path

    from rich.console import Console
    from rich.text import Text

    from padgs.apps.export.explicit import DISTILLATION_STEPS, UNSMOOTHED, export_run
    from padgs.apps.export.splat_file import CONVERTED, check_suffix, write_splats
    from padgs.files import check_place
    from padgs.runs.load import load_run

    check_range(0, 100_000, distillation_steps=distillation_steps)
    steps = DISTILLATION_STEPS if distillation_steps is None else distillation_steps
    path = Path(to) if to else Path(run) / "splats.ply"
    check_suffix(path)
    box = _box(crop) if crop else None
    with Console().status("opening the run") as status:
        trained = load_run(run, data_path=data, device=device)
        with name_place(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            check_place(path)
        found = export_run(
            trained,
            distillation_steps=steps,
            upright=upright or path.name.lower().endswith(CONVERTED),  # a .ply says which axis is up
            smooth=smooth or path.suffix.lower() == ".html",
            crop=box,
            progress=lambda done: status.update(f"distillation step {done} of {steps}"),
        )
        status.update(Text(f"writing {printable(path.name)}"))
        with name_place(path):
            lost = write_splats(path, found.splats, found.notes, start=found.start)
    notes = [note for note in (*trained.notes, *found.notes, lost) if note and (smooth or note != UNSMOOTHED)]
    show("\n".join(f"  {note}" for note in notes))
    show(f"{path}: {len(found.splats)} Gaussians, {path.stat().st_size / 1e6:.1f} MB")


def _box(text: str) -> list[float]:
    try:
        box = [float(number) for number in text.replace(",", " ").split()]
    except ValueError:
        box = []
    if len(box) != 6 or not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
        raise ValueError(f"--crop is {text}; it must be six numbers, lowest x y z and then a higher x y z each")
    return box
