"""`padgs track`: mirror finished runs into mlflow."""

from __future__ import annotations

from typing import Annotated

import typer

from padgs.cli.errors import show


def track(
    runs: Annotated[str, typer.Argument(help="folder of run folders")] = "runs",
    uri: Annotated[str, typer.Option(help="of a server or database; default: mlflow.db in RUNS")] = "",
) -> None:
    """Mirror finished runs into mlflow, for example runs of a cluster."""
    from pathlib import Path

    from padgs import results
    from padgs.runs.tracking import Tracker, TrackingOptions

    if not Path(runs).is_dir():
        raise FileNotFoundError(f"there is no folder {runs}; give the folder of the runs")
    found, broken = results.read_all(Path(runs))
    for error in broken:
        show(f"left out: {error}")
    if not found:
        raise ValueError(f"no finished run is in {runs}; give the folder of the runs")
    options, trackers = TrackingOptions("mlflow", uri or None), dict[str, Tracker]()
    for folder, result in found.items():
        experiment = " ".join(name for name in result.experiments if name != results.AD_HOC)
        if experiment not in trackers:
            trackers[experiment] = Tracker(options, Path(runs), experiment, show)
        trackers[experiment].add(folder)
        if not trackers[experiment].on:
            raise typer.Exit(1)
    show(f"mirrored: {len(found)} runs, as {', '.join(tracker.name for tracker in trackers.values())}")
