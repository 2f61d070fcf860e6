"""What a person reads about a run: what it is, at its beginning, and a small table at its end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from padgs.evaluation import BANDS
from padgs.results import Result
from padgs.runs.live import compact, duration
from padgs.runs.terminal import printable, say

if TYPE_CHECKING:
    from padgs.runs.config import RunConfig
    from padgs.scene import Scene

MISSING = "–"
MEANINGS = {  # word of a metric -> what it says, with an arrow towards the better end
    "psnr": "↑ dB",
    "ssim": "↑ likeness of structure",
    "lpips": "↓ perceptual distance",
    "seam": "error at ±180° over elsewhere, best 1",
}


def introduce(config: RunConfig, scene: Scene, folder: Path, console: Console) -> None:
    """Print what is trained on what, the notes of the loader, and where the files will be."""
    view = scene.train[0]
    what = f"{config.preset}{f' ({config.row})' if config.row else ''} on {scene.name}"
    views = f"{len(scene.train)} training and {len(scene.test)} test views of {view.width}x{view.height}"
    rest = f": {views}, {len(scene.points)} points, {config.time}, on {scene.points.device}"
    console.print(Text(printable(what), "bold"), rest, sep="", highlight=False, soft_wrap=True)
    for note in (*scene.notes, folder):
        say(console, f"  {note}", "dim")


def show_result(result: Result, folder: Path, console: Console) -> None:
    """Print the marks of a run, what it cost, and where its files are."""
    if not result.ok:
        reason = printable(result.reason) or "stopped early"
        console.print(Text.assemble((result.status, "bold red"), f": {reason}"), soft_wrap=True)
    if result.ended:
        say(console, f"stopped early, after {result.iterations_done} iterations: {printable(result.ended)}", "yellow")
    if result.scores:
        console.print(marks(result))
    for note in dict.fromkeys(note for scores in result.scores.values() for note in scores.notes):
        say(console, note, "yellow")
    costs = [f"{compact(count)} {name}" for name, count in result.counts.items()]
    costs.append(f"{result.model_bytes / 1e6:.1f} MB")
    if "train_seconds" in result.timing:
        costs.append(f"trained {duration(result.timing['train_seconds'])}")
    if "render_ms_median" in result.timing:
        costs.append(f"{result.timing['render_ms_median']:.1f} ms per frame")
    costs.append(f"peak memory {result.peak_memory_bytes / 1e9:.2f} GB")
    if result.peak_device_memory_bytes is not None:
        costs.append(f"{result.peak_device_memory_bytes / 1e9:.2f} GB on the GPU")
    say(console, ", ".join(costs))
    say(console, folder, "bold")


def marks(result: Result) -> Table:
    """One row per metric, one column per protocol, and what the metric says."""
    table = Table("metric", box=SIMPLE_HEAD)
    for protocol in result.scores:
        table.add_column(protocol, justify="right")
    table.add_column(style="dim")
    for metric in dict.fromkeys(name for scores in result.scores.values() for name in scores.metrics):
        values = [scores.metrics.get(metric) for scores in result.scores.values()]
        table.add_row(metric, *(number(metric, value) for value in values), meaning(metric))
    return table


def meaning(metric: str) -> str:
    """What a metric says, in a line, with an arrow towards its better end.

    >>> meaning("ws_psnr_pole"), meaning("lpips_vgg_01")
    ('↑ dB, 75 to 90° up and down', '↓ perceptual distance')
    """
    words = metric.split("_")
    quantity = next((text for word, text in MEANINGS.items() if word in words), "")
    band = BANDS.get(words[-1])
    where = _where(band) if band else "by solid angle" if words[0] == "ws" else ""
    return ", ".join(filter(None, (quantity, where)))


def number(metric: str, value: float | None) -> str:
    """A mark as tables show it: decibels with two decimals, all else with three.

    >>> number("ws_psnr", 24.256), number("ssim", 0.5), number("lpips_vgg", None)
    ('24.26', '0.500', '–')
    """
    if value is None:
        return MISSING
    return f"{value:.2f}" if "psnr" in metric else f"{value:.3f}"


def _where(band: Sequence[tuple[int, int]]) -> str:
    first, last = band[-1]
    if first == -last:
        return f"within {last}° of the horizon"
    low, high = sorted((abs(first), abs(last)))
    return f"{low} to {high}° {'up and down' if len(band) > 1 else 'up' if last < 0 else 'down'}"
