"""What the commands that open one run have in common: its folder, its data set, and how they are opened."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from padgs.runs.opened import OpenedRun

Run = Annotated[str, typer.Argument(help="folder of a run, finished or not, as padgs-run names it at its end")]
DataPath = Annotated[str | None, typer.Option("--data", help="where its data set is now, if not where it was")]


def opened(run: str, data: str | None) -> OpenedRun:
    """The run of a folder.

    Raises:
        ValueError, OSError: it cannot be opened.
    """
    from padgs.runs.checkpoint import CheckpointError
    from padgs.runs.folder import RunFolderError
    from padgs.runs.opened import load_run

    try:
        return load_run(run, data_path=data)
    except (RunFolderError, CheckpointError) as error:
        raise ValueError(str(error)) from error
