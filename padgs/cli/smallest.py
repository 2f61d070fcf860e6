"""`padgs smallest`: search for the smallest model that is as good as that of a run."""

from __future__ import annotations

from typing import Annotated

import typer

from padgs.cli.errors import DataPath
from padgs.results import SMALLEST_LOSSES, SMALLEST_STATED

KNOWN = ", ".join(f"{loss:g}" for loss in SMALLEST_LOSSES)


def smallest(
    run: Annotated[str, typer.Argument(help="folder of a finished run, as padgs-run names it at its end")],
    epsilon: Annotated[float, typer.Option(help=f"dB that the kept model may lose: {KNOWN}")] = SMALLEST_STATED,
    data: DataPath = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda")] = "auto",
) -> None:
    """Search for the smallest model as good as that of a finished run, for several losses; keep one as a run."""
    from rich.console import Console

    from padgs.runs.load import load_run
    from padgs.runs.smallest import find_smallest

    if epsilon not in SMALLEST_LOSSES:
        raise ValueError(f"--epsilon is {epsilon:g}; it must be one of {KNOWN}")
    opened = load_run(run, data_path=data, device=device)
    if opened.result is None or not opened.result.ok:
        state = "not finished" if opened.result is None else f"of status {opened.result.status}"
        raise ValueError(f"{run} is {state}; only a run that ended well is searched, so start it again first")
    find_smallest(opened, epsilon, Console(highlight=False, soft_wrap=True))
