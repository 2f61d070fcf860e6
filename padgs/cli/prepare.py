"""`padgs prepare`: from panoramas or a 360-degree video to a data set that is ready for training."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from padgs.cli.errors import MAX_SEED, MAX_THREADS, Mask, as_options, check_range, show
from padgs.runs.interrupt import Interrupted

if TYPE_CHECKING:
    from rich.progress import TaskID

WORDS = {
    "frames": "choosing frames",
    "images": "looking at images",
    "views": "rendering views",
    "features": "finding features",
    "matches": "matching pairs",
    "poses": "placing panoramas",
    "result": "refining and writing",
}

Metres = Annotated[
    tuple[str, str, float] | None,
    typer.Option(metavar="A B DISTANCE", help="scale the world: panoramas A and B were taken DISTANCE metres apart"),
]
CameraHeight = Annotated[float | None, typer.Option(help="scale the world: metres from the floor to the cameras")]
Gps = Annotated[bool, typer.Option("--gps", help="scale and turn the world by the GPS in the EXIF of the images")]


def prepare(
    source: Annotated[str, typer.Argument(help="folder of panoramas, or a stitched 360-degree video")],
    destination: Annotated[str, typer.Argument(help="a folder that does not exist yet")],
    accurate: Annotated[bool, typer.Option("--accurate", help="find features in undistorted views; 5x slower")] = False,
    pairs: Annotated[str, typer.Option(help="to match: auto, exhaustive, sequential (by name) or similar")] = "auto",
    mask: Mask = "auto",
    level: Annotated[bool, typer.Option(help="turn the world so that the cameras' common up is +z")] = True,
    per_second: Annotated[float, typer.Option(help="frames to keep per second of video")] = 2.0,
    seed: Annotated[int, typer.Option(help="random seed")] = 0,
    mapper: Annotated[str, typer.Option(help="incremental, or global, for hundreds of panoramas")] = "incremental",
    metres: Metres = None,
    camera_height: CameraHeight = None,
    gps: Gps = False,
    threads: Annotated[int, typer.Option(help="0: one per core, at most 8, as memory allows; fewer use less")] = 0,
) -> None:
    """Find the poses of panoramas, then check the result. After an interruption, the same command continues."""
    from pathlib import Path

    from padgs.cli.check import end_with, overlay_path
    from padgs.data.check import check
    from padgs.data.metres import KnownLength
    from padgs.data.prepare.pipeline import place_of
    from padgs.data.prepare.pipeline import prepare as find_poses
    from padgs.data.prepare.work import PrepareOptions

    check_range(0, MAX_SEED, seed=seed)
    check_range(0, MAX_THREADS, threads=threads)
    check_range(0.001, 1000, per_second=per_second)
    target = Path(destination).resolve()  # of a link to a larger disk
    try:
        with _bars() as tell:
            known = KnownLength(metres, camera_height, gps)
            options = PrepareOptions(accurate, pairs, mask, level, per_second, seed, mapper, known, threads)
            result = find_poses(Path(source), target, options, tell)
            report = check(target, overlay=overlay_path(target))
    except KeyboardInterrupt as interrupt:
        is_kept = target.exists() or place_of(target).is_dir()
        way_on = "continues" if is_kept else "starts over: its first step was not complete"
        raise Interrupted(f"interrupted; the same command {way_on}") from interrupt
    placed = len(result.registered)
    print(f"{placed} of {placed + len(result.unregistered)} panoramas placed, {result.points} points")
    spent = ", ".join(f"{WORDS[step]} {seconds:.0f} s" for step, seconds in result.seconds.items() if seconds >= 1)
    for note in (*result.notes, spent) if spent else result.notes:
        show(as_options(f"  {note}", ["mask"]))
    end_with(report, ["mask"])


@contextmanager
def _bars() -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar per step with the remaining time; without a terminal, print a line at each tenth."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    tasks: dict[str, tuple[TaskID, int]] = {}  # step -> bar, tenths that were told

    def tell(step: str, done: int, total: int) -> None:
        task, told = tasks.get(step) or (bars.add_task(WORDS[step], total=total), -1)
        bars.update(task, completed=done, total=total)
        tenth = 10 * done // max(total, 1)
        if bars.disable and tenth > told:
            print(f"{WORDS[step]} {done}/{total}", flush=True)
        tasks[step] = (task, tenth)

    columns = (TextColumn("{task.description:<20}"), BarColumn(), MofNCompleteColumn())
    bars = Progress(*columns, TimeRemainingColumn(elapsed_when_finished=True))
    bars.disable = not bars.console.is_terminal
    with bars:
        yield tell
