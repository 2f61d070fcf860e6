"""`padgs view`: a run in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from padgs import results
from padgs.cli.errors import DataPath, Run, check_range

if TYPE_CHECKING:
    from padgs.runs.load import LoadedRun


def view(
    run: Run,
    beside: Annotated[str, typer.Option(help="another run of the same scene, to compare with")] = "",
    port: Annotated[int | None, typer.Option(help="the first one to try; default 8080")] = None,
    host: Annotated[
        str | None,
        typer.Option(help="0.0.0.0 serves all who have the printed address; default: this machine only"),
    ] = None,
    data: DataPath = None,
) -> None:
    """Walk through a run in the browser, rendered by its own renderer; a run in training is followed."""
    from padgs.apps.viewer.server import LOCAL, PORT, has_screen, serve, wait_for_checkpoint

    check_range(1, 65535, port=port)
    folders = (run, beside) if beside else (run,)

    def of_one_scene() -> list[LoadedRun]:
        from padgs.runs.load import load_run

        runs, names = [], []
        for folder in folders:
            wait_for_checkpoint(folder)
            runs.append(found := load_run(folder, data_path=data))
            names.append(found.scene.name)
        if len({*names}) > 1:
            scenes = " and ".join(names)
            raise ValueError(f"{run} and {beside} are of two scenes, {scenes}; name two runs of one scene")
        return runs

    if not all((Path(folder) / results.CONFIG_NAME).is_file() for folder in folders):
        of_one_scene()  # raises before the page is served
    serve(of_one_scene, host=host or LOCAL, port=port or PORT, browse=has_screen())
