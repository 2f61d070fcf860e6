"""`padgs need`: how many Gaussians does the scene of a run need?"""

from __future__ import annotations

from typing import Annotated

import typer

from padgs.cli.errors import DataPath, exit_on, name_run
from padgs.results import NEED_LOSSES, NEED_STATED

KNOWN = ", ".join(f"{loss:g}" for loss in NEED_LOSSES)


def need(
    run: Annotated[str, typer.Argument(help="folder of a finished run, as padgs-run names it at its end")],
    epsilon: Annotated[float, typer.Option(help=f"dB that the kept model may lose: {KNOWN}")] = NEED_STATED,
    data: DataPath = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda")] = "auto",
) -> None:
    """Find the smallest model as good as a trained one, for several losses; keep one as a run of its own."""
    from rich.console import Console

    from padgs.need.entry import search
    from padgs.runs.interrupt import INTERRUPTED, Interrupted
    from padgs.runs.load import load_run

    console = Console(highlight=False, soft_wrap=True)
    try:
        with exit_on(OSError, RuntimeError, ValueError):
            if epsilon not in NEED_LOSSES:
                rule = "must be > 0" if not epsilon > 0 else "is none of those that are searched for"
                raise ValueError(f"--epsilon is {epsilon:g}; it {rule}: {KNOWN}")
            opened = load_run(run, data_path=data, device=device)
            if opened.result is None or not opened.result.ok:
                state = "not finished" if opened.result is None else f"of status {opened.result.status}"
                raise ValueError(f"{run} is {state}; a need is that of a run that ended well, so start it again first")
            with name_run(run):
                search(opened, epsilon, console)
    except Interrupted as interrupted:  # outside of `refusing`, to which Exit is an error
        console.print(str(interrupted))
        raise typer.Exit(INTERRUPTED) from interrupted
