"""`padgs prepare`: from panoramas or a 360-degree video to a data set that is ready for training."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console
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


def prepare(
    source: Annotated[str, typer.Argument(help="folder of panoramas, or a stitched 360-degree video")],
    destination: Annotated[str, typer.Argument(help="a folder that does not exist yet")],
    accurate: Annotated[
        bool, typer.Option("--accurate", help="features in undistorted views; about 5x slower")
    ] = False,
    pairs: Annotated[str, typer.Option(help="auto, exhaustive, or sequential: names in the order taken")] = "auto",
    mask: Annotated[str, typer.Option(help="auto, none, rows:959/1024, or a file or folder; 255 = use")] = "auto",
    level: Annotated[bool, typer.Option(help="turn the world so that the cameras' common up is +z")] = True,
    per_second: Annotated[float, typer.Option(help="frames kept per second of video")] = 2.0,
    seed: Annotated[int, typer.Option(help="of all random choices")] = 0,
    threads: Annotated[int, typer.Option(help="processor threads; 0 = all, at most 8")] = 0,
) -> None:
    """Find the poses of panoramas, then check the result. Interrupted, the same command goes on where it stopped."""
    from pathlib import Path

    from rich.console import Console

    from padgs.cli.check import lines
    from padgs.data.check.report import check
    from padgs.data.errors import DataError
    from padgs.data.prepare.pipeline import PrepareOptions
    from padgs.data.prepare.pipeline import prepare as find_poses

    console = Console(highlight=False, soft_wrap=True)
    target = Path(destination)
    try:
        options = PrepareOptions(accurate, pairs, mask, level, per_second, seed, threads)
        with _Bars(console) as tell:
            result = find_poses(Path(source), target, options, tell)
        report = check(target, overlay=target / "check.png")
    except DataError as error:
        console.print(str(error), markup=False)
        raise typer.Exit(1) from error
    except KeyboardInterrupt as interrupt:
        console.print("interrupted; the same command goes on where this stopped", markup=False)
        raise typer.Exit(130) from interrupt
    placed = len(result.registered)
    console.print(f"{placed} of {placed + len(result.unregistered)} panoramas placed, {result.points} points")
    for note in result.notes:
        console.print(f"  {note}", markup=False)
    spent = ", ".join(f"{WORDS[step]} {seconds:.0f} s" for step, seconds in result.seconds.items() if seconds >= 1)
    if spent:
        console.print(f"  {spent}", markup=False)
    for line in lines(report):
        console.print(line, markup=False)
    raise typer.Exit(1 if report.problems else 0)


class _Bars:
    """One bar per step, with the time that is left; plain lines now and then where there is no terminal."""

    def __init__(self, console: Console) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._console = console
        self._bars = Progress(
            TextColumn("{task.description:<20}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=console,
            disable=not console.is_terminal,
        )
        self._tasks: dict[str, tuple[TaskID, int]] = {}  # step -> bar, tenths that were told

    def __enter__(self) -> Callable[[str, int, int], None]:
        self._bars.start()
        return self._tell

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def _tell(self, step: str, done: int, total: int) -> None:
        task, told = self._tasks.get(step) or (self._bars.add_task(WORDS[step], total=total), -1)
        self._bars.update(task, completed=done, total=total)
        tenth = 10 * done // total
        if not self._console.is_terminal and tenth > told:
            self._console.print(f"{WORDS[step]} {done}/{total}", markup=False)
        self._tasks[step] = (task, tenth)
