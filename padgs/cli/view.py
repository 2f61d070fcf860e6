"""`padgs view`: a run in the browser."""

from __future__ import annotations

from typing import Annotated

import typer

from padgs.cli.opening import DataPath, Run, opened
from padgs.cli.refusing import refusing


@refusing(ValueError, OSError)
def view(
    run: Run,
    beside: Annotated[str, typer.Option(help="another run of the same scene, to compare with")] = "",
    port: Annotated[int, typer.Option(help="the first one to try")] = 8080,
    host: Annotated[str, typer.Option(help="0.0.0.0 shows it to the whole network, without a password")] = "127.0.0.1",
    data: DataPath = None,
) -> None:
    """Walk through a run in the browser, drawn here by the run's own renderer. Ctrl-C ends it."""
    from threading import Event

    from padgs.viewer.server import serving

    runs = [opened(folder, data) for folder in (run, beside) if folder]
    with serving(runs, host=host, port=port) as server:
        print(f"{server.address}  (Ctrl-C ends it)", flush=True)
        try:
            Event().wait()
        except KeyboardInterrupt:
            print()
