"""Output of runs on a terminal. Control characters and markup in names and messages are printed, not obeyed."""

from __future__ import annotations

import shlex
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rich.box import SIMPLE_HEAD
from rich.console import Console, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from padgs.checks import printable
from padgs.evaluation import BANDS
from padgs.results import Result

if TYPE_CHECKING:
    from padgs.runs.config import RunConfig
    from padgs.scene import Scene
    from padgs.training.loop import Record

REDRAWS_PER_SECOND = 5
SECONDS_BETWEEN_LINES = 10.0  # without a terminal
RECENT = 64  # records that the speed is measured over
# Errors of a terminal that was closed, and of rich for a pipe whose reader has ended: they end no run.
UNREAD = (OSError, SystemExit)
COLUMNS, BAR = 80, 8  # characters of the progress line, and of the bar in it
MISSING = "–"
# Least PSNR of a verdict in words
SHARPNESS = ((28, "sharp"), (24, "slightly soft"), (20, "blurred"), (-float("inf"), "hardly recognisable"))
MEANINGS = {  # word in the name of a metric -> meaning, with an arrow towards better values
    "psnr": "↑ dB",
    "ssim": "↑ structural similarity",
    "lpips": "↓ perceptual distance",
    "seam": "error at ±180° over elsewhere, best 1",
    "rel": "↓ relative error of depth",
    "delta": "↑ share of depths within a factor of 1.25",
}

D = TypeVar("D", bound="Display")


def say(console: Console, text: object, style: str = "") -> None:
    """Print lines without wrapping."""
    write(console, Text(printable(str(text)), style), soft_wrap=True)


def write(console: Console, *parts: RenderableType, **options: Any) -> None:
    """Print to a console that may have been closed."""
    with suppress(*UNREAD):
        console.print(*parts, **options)


class Display:
    """A part of the console that is redrawn; its last content stays."""

    def __init__(self, console: Console, *, redraw: float, line: float, transient: bool = False) -> None:
        """Redraw every `redraw` seconds in a terminal, transient or not; print every `line` seconds elsewhere."""
        self._console, self._shown = console, 0.0
        live = Live(console=console, auto_refresh=False, transient=transient) if console.is_terminal else None
        self._live, self._interval = live, line if live is None else redraw

    def __enter__(self: D) -> D:
        self._shown = time.monotonic()
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(*UNREAD):
            if self._live is not None:
                self._live.stop()

    @property
    def is_due(self) -> bool:
        """True if it is time to redraw."""
        return time.monotonic() - self._shown >= self._interval

    def show(self, line: str) -> None:
        """Show a line."""
        self._shown = time.monotonic()
        with suppress(*UNREAD):
            if self._live is not None:
                self._live.update(Text(line, no_wrap=True, overflow="ellipsis"), refresh=True)
            else:
                self._console.print(line, highlight=False, soft_wrap=True)


class LiveLine(Display):
    """Progress of one run: remaining time, a bar, iteration, loss, held-out PSNR, count and speed."""

    def __init__(self, console: Console, transient: bool = False) -> None:
        super().__init__(console, redraw=1 / REDRAWS_PER_SECOND, line=SECONDS_BETWEEN_LINES, transient=transient)
        self._times: deque[tuple[int, float, float]] = deque(maxlen=RECENT)
        self._psnr: float | None = None
        self._loss: float | None = None

    def update(self, record: Record, psnr: float | None) -> None:
        """Show a record and the last measured PSNR of the held-out view."""
        self._times.append((record.iteration, record.progress, time.monotonic()))
        self._psnr = self._psnr if psnr is None else psnr
        self._loss = record.loss if isinstance(record.loss, float) else self._loss  # others wait for a GPU, untimed
        if self.is_due or len(self._times) == 1 or record.progress == 1:
            self.show(self._line(record))

    def _line(self, record: Record) -> str:
        (first, behind, start), (latest, share, end) = self._times[0], self._times[-1]
        left = duration((1 - share) / (share - behind) * (end - start)) if share > behind else MISSING
        filled = round(BAR * share)
        parts = [f"ETA {left}", f"{'█' * filled}{'░' * (BAR - filled)} {share:4.0%}", f"{record.iteration}"]
        parts += [] if self._loss is None else [f"loss {self._loss:.4f}"]
        if self._psnr is not None:
            parts.append(f"{self._psnr:.2f} dB")
        parts += [f"{compact(count)} {name}" for name, count in [*record.counts.items()][:1]]
        if share > behind:
            parts.append(f"{compact(round((latest - first) / max(end - start, 1e-9), 1))} it/s")
        return "  ".join(parts)[:COLUMNS]


def compact(count: float) -> str:
    """Return a count in at most five characters.

    >>> [compact(n) for n in (987, 12_345, 123_456, 2_345_678)]
    ['987', '12.3k', '123k', '2.35M']
    """
    if count < 1000:
        return str(count)
    return f"{count / 1000:.3g}k" if count < 999_500 else f"{count / 1e6:.3g}M"


def duration(seconds: float) -> str:
    """Return a duration as [hours:]minutes:seconds.

    >>> [duration(s) for s in (7, 72, 3723)]
    ['0:07', '1:12', '1:02:03']
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def introduce(config: RunConfig, scene: Scene, folder: Path, console: Console) -> None:
    """Print method, scene, notes of the loader, and the run folder."""
    view = scene.train[0]
    what = f"{config.preset}{f' ({config.row})' if config.row else ''} on {scene.name}"
    views = f"{len(scene.train)} training and {len(scene.test)} test views of {view.width}x{view.height}"
    rest = f": {views}, {len(scene.points)} points, {config.time}, on {scene.points.device}"
    write(console, Text(printable(what), "bold"), rest, sep="", highlight=False, soft_wrap=True)
    for note in (*scene.notes, folder):
        say(console, f"  {note}", "dim")


def show_result(result: Result, folder: Path, console: Console) -> None:
    """Print metrics, cost and folder of a run."""
    if not result.ok:
        reason = printable(result.reason) or "stopped early"
        write(console, Text.assemble((result.status, "bold red"), f": {reason}"), soft_wrap=True)
    if result.ended:
        say(console, f"stopped early, after {result.iterations_done} iterations: {printable(result.ended)}", "yellow")
    if result.scores:
        say(console, headline(result), "bold" if result.ok else "")
        write(console, metric_table(result))
    for note in dict.fromkeys(note for scores in result.scores.values() for note in scores.notes):
        say(console, note, "yellow")
    timing, peak, on_gpu = result.timing, result.peak_memory_bytes, result.peak_device_memory_bytes
    costs = [f"{compact(count)} {name}" for name, count in result.counts.items()]
    if result.model_bytes:
        costs.append(f"{result.model_bytes / 1e6:.1f} MB")
    costs += [f"trained {duration(timing['train_seconds'])}"] if "train_seconds" in timing else []
    costs += [f"{timing['render_ms_median']:.1f} ms per frame"] if "render_ms_median" in timing else []
    costs += [f"peak memory {peak / 1e9:.2f} GB"] if peak else []  # not measured for models of other programs
    costs += [] if on_gpu is None else [f"{on_gpu / 1e9:.2f} GB on the GPU"]
    say(console, ", ".join(costs))
    say(console, folder, "bold")
    if result.ok and not result.external:
        say(console, f"next: {shlex.join(['padgs', 'view', str(folder)])}", "dim")


def psnr_of(result: Result) -> float | None:
    """Return the PSNR of a result, under the first protocol that has one."""
    values = (scores.metrics.get(name) for name in ("psnr", "ws_psnr") for scores in result.scores.values())
    return next((value for value in values if value is not None), None)


def headline(result: Result) -> str:
    """Return the quality of a run in a sentence.

    >>> from padgs.results import Scores
    >>> from types import SimpleNamespace as Some
    >>> headline(Some(scores={"paper": Scores({}, {"psnr": 29.93}, {"a": {}, "b": {}})}, dataset="", ok=True))
    '29.9 dB on 2 held-out photographs: sharp'
    """
    psnr, count = psnr_of(result), max((len(scores.views) for scores in result.scores.values()), default=0)
    views = f"held-out {'view' if result.dataset == 'synthetic' else 'photograph'}{'' if count == 1 else 's'}"
    if psnr is None:
        return f"scored on {count} {views}"
    word = next(word for least, word in SHARPNESS if psnr >= least)
    return f"{psnr:.1f} dB on {count} {views}" + (f": {word}" if result.ok else "")


def metric_table(result: Result) -> Table:
    """Return a table of metrics: a row per metric, a column per protocol, and the meaning."""
    table = Table("metric", box=SIMPLE_HEAD)
    for protocol in result.scores:
        table.add_column(protocol, justify="right")
    table.add_column(style="dim")
    for metric in dict.fromkeys(name for scores in result.scores.values() for name in scores.metrics):
        values = [scores.metrics.get(metric) for scores in result.scores.values()]
        table.add_row(metric, *(number(metric, value) for value in values), meaning(metric))
    return table


def meaning(metric: str) -> str:
    """Return the meaning of a metric in a line, with an arrow towards better values.

    >>> meaning("ws_psnr_pole"), meaning("lpips_vgg_01")
    ('↑ dB, 75 to 90° up and down', '↓ perceptual distance')
    """
    words = metric.split("_")
    quantity = next((text for word, text in MEANINGS.items() if word in words), "")
    where = "by solid angle" if words[0] == "ws" else ""
    if band := BANDS.get(words[-1]):
        first, last = band[-1]
        low, high = sorted((abs(first), abs(last)))
        side = "up and down" if len(band) > 1 else "up" if last < 0 else "down"
        where = f"within {last}° of the horizon" if first == -last else f"{low} to {high}° {side}"
    return ", ".join(filter(None, (quantity, where)))


def number(metric: str, value: float | None) -> str:
    """Format the value of a metric: decibels with two decimals, others with three.

    >>> number("ws_psnr", 24.256), number("ssim", 0.5), number("lpips_vgg", None)
    ('24.26', '0.500', '–')
    """
    if value is None:
        return MISSING
    return f"{value:.2f}" if "psnr" in metric else f"{value:.3f}"
