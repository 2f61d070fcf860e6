"""`padgs track`: mirror finished runs into mlflow, whoever ran them."""

from __future__ import annotations

from typing import Annotated

import typer

from padgs.cli.refusing import refusing, show


@refusing(FileNotFoundError)
def track(
    runs: Annotated[str, typer.Argument(help="folder of run folders")] = "runs",
    uri: Annotated[str, typer.Option(help="of a server or database; mlflow.db in RUNS if not given")] = "",
) -> None:
    """Mirror finished runs into mlflow: those of a cluster, or of a time when its server was away."""
    from pathlib import Path

    from padgs import results
    from padgs.tracking.tracker import Tracker, TrackingOptions

    if not Path(runs).is_dir():
        raise FileNotFoundError(f"there is no folder {runs}; give the folder of the runs")
    trackers: dict[str, Tracker] = {}
    mirrored = 0
    for path in sorted(Path(runs).glob(f"*/{results.FILE_NAME}")):
        try:
            result = results.read(path)
        except results.ResultError as error:
            show(f"left out: {error}")
            continue
        experiment = " ".join(name for name in result.experiments if name != results.BY_ITSELF)
        if experiment not in trackers:
            trackers[experiment] = Tracker(TrackingOptions(uri=uri or None), Path(runs), experiment, show)
        trackers[experiment].update(path.parent)
        if not trackers[experiment].on:
            raise typer.Exit(1)
        mirrored += 1
    print(f"mirrored: {mirrored} runs, as {', '.join(tracker.name for tracker in trackers.values())}")
