"""`padgs smallest` and `padgs track`: searches from finished runs, and their copies in mlflow."""

from typing import Annotated

import typer

from padgs.cli.errors import DataPath, Device, show
from padgs.results import SMALLEST_LOSSES, SMALLEST_STATED

KNOWN = ", ".join(f"{loss:g}" for loss in SMALLEST_LOSSES)


def smallest(
    run: Annotated[str, typer.Argument(help="folder of a finished run, as padgs-run names it at its end")],
    epsilon: Annotated[float, typer.Option(help=f"dB that the kept model may lose: {KNOWN}")] = SMALLEST_STATED,
    data: DataPath = None,
    device: Device = "auto",
) -> None:
    """Search for the smallest model that is as good as that of a finished run, and keep it as a run."""
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


def track(
    runs: Annotated[str, typer.Argument(help="folder of run folders")] = "runs",
    uri: Annotated[str, typer.Option(help="URI of an mlflow server or database; default: mlflow.db in RUNS")] = "",
) -> None:
    """Mirror finished runs into mlflow, for example runs of a cluster."""
    from pathlib import Path

    from padgs.reports import store
    from padgs.results import AD_HOC
    from padgs.runs.tracking import Tracker, TrackingOptions

    if not Path(runs).is_dir():
        raise FileNotFoundError(f"there is no folder {runs}; give the folder of the runs")
    found, broken = store.read(Path(runs))
    for error in broken:
        show(f"left out: {error}")
    if not found:
        raise ValueError(f"no finished run is in {runs}; give the folder of the runs")
    options, trackers = TrackingOptions("mlflow", uri or None), dict[str, Tracker]()
    for run in found:
        experiment = " ".join(name for name in run.result.experiments if name != AD_HOC)
        if experiment not in trackers:
            trackers[experiment] = Tracker(options, Path(runs), experiment, show)
        assert run.renders is not None, "read from a folder"
        trackers[experiment].add(run.renders.parent)
        if not trackers[experiment].on:
            raise typer.Exit(1)
    show(f"mirrored: {len(found)} runs, as {', '.join(tracker.name for tracker in trackers.values())}")
