"""`padgs view`: a run in the browser."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from padgs import results
from padgs.cli.errors import DataPath, Device, Model, Rays, Transform, check_range, show

if TYPE_CHECKING:
    from padgs.runs.load import LoadedRun


def view(
    run: Model,
    beside: Annotated[str, typer.Option(help="another run of the same scene, to compare with")] = "",
    port: Annotated[int | None, typer.Option(help="first port to try; default 8080")] = None,
    host: Annotated[str | None, typer.Option(help="0.0.0.0 serves all with the address; default: this machine")] = None,
    data: DataPath = None,
    rays: Rays = "exact",
    transform: Transform = "",
    device: Device = "auto",
) -> None:
    """Walk through a run in the browser, also while it trains, rendered by its own renderer."""
    from padgs.apps.viewer.server import LOCAL, PORT, has_screen, serve, wait_for_checkpoint

    check_range(1, 65535, port=port)
    folders = (run, beside) if beside else (run,)
    opened: list[LoadedRun] = []

    def of_one_scene() -> list[LoadedRun]:
        from padgs.apps.external import is_splat_file, open_model

        files = [folder for folder in folders if is_splat_file(folder)]
        place = data or next((folder for folder in folders if folder not in files), None)
        for folder in folders:
            wait_for_checkpoint(folder)
        for folder in folders:
            stated = (rays, transform) if folder in files or not files else ()  # a run beside a file has its own
            opened.append(open_model(folder, place if folder in files else data, *stated, device=device))
            for note in opened[-1].notes:
                show(f"  {note}")
        if len(names := [*dict.fromkeys(found.scene.name for found in opened)]) > 1:
            raise ValueError(f"{run} and {beside} are of two scenes, {' and '.join(names)}; name two runs of one scene")
        return opened

    if not all((Path(folder) / results.CONFIG_NAME).is_file() for folder in folders):
        of_one_scene()  # raises before the page is served
    try:
        serve(lambda: opened or of_one_scene(), host=host or LOCAL, port=port or PORT, browse=has_screen())
    except KeyboardInterrupt:  # the way to end it
        command = shlex.join(["padgs", "render", run, *(opened[0].opened_with if opened else ())])
        show(f"next: {command}  (--path film.json after saving a film)")
        raise
