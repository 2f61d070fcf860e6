"""What a person sees of work in progress: a picture that changes in a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, TypeVar

from rich.console import Console, RenderableType
from rich.live import Live
from rich.text import Text

if TYPE_CHECKING:
    from padgs.training.loop import Record

REDRAWS_PER_SECOND = 5
SECONDS_BETWEEN_LINES = 10.0  # where there is no terminal
RECENT = 64  # records that the speed is taken from

D = TypeVar("D", bound="Display")


class Display:
    """A place on the console for what changes; the last picture stays."""

    def __init__(self, console: Console, *, redraw: float, line: float) -> None:
        """Show something new after `redraw` seconds in a terminal, after `line` seconds elsewhere."""
        self._console = console
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._interval = line if self._live is None else redraw
        self._shown = 0.0

    def __enter__(self: D) -> D:
        self._shown = time.monotonic()
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    @property
    def is_due(self) -> bool:
        """Whether what is shown is old."""
        return time.monotonic() - self._shown >= self._interval

    def show(self, line: str, picture: RenderableType | None = None) -> None:
        """Show a line, or in a terminal what says more."""
        self._shown = time.monotonic()
        if self._live is not None:
            self._live.update(picture or Text(line, no_wrap=True, overflow="ellipsis"), refresh=True)
        else:
            self._console.print(line, highlight=False, soft_wrap=True)


class LiveLine(Display):
    """Of one run: iteration and share of the run, loss, held-out PSNR, counts, speed and the time that is left."""

    def __init__(self, console: Console) -> None:
        super().__init__(console, redraw=1 / REDRAWS_PER_SECOND, line=SECONDS_BETWEEN_LINES)
        self._times: deque[tuple[int, float, float]] = deque(maxlen=RECENT)
        self._psnr: float | None = None

    def update(self, record: Record, psnr: float | None) -> None:
        """Take in a record and, where it was measured, the PSNR of the held-out view."""
        self._times.append((record.iteration, record.progress, time.monotonic()))
        self._psnr = self._psnr if psnr is None else psnr
        if self.is_due or len(self._times) == 1 or record.progress == 1:
            self.show(self._line(record))

    def _line(self, record: Record) -> str:
        parts = [f"{record.iteration} ({record.progress:.0%})", f"loss {float(record.loss):.4f}"]
        if self._psnr is not None:
            parts.append(f"PSNR {self._psnr:.2f}")
        parts += [f"{name} {compact(count)}" for name, count in record.counts.items()]
        (first, behind, start), (latest, share, end) = self._times[0], self._times[-1]
        if share > behind:
            parts += [f"{(latest - first) / max(end - start, 1e-9):.1f} it/s"]
            parts += [f"ETA {duration((1 - share) / (share - behind) * (end - start))}"]
        return "  ".join(parts)


def compact(count: int) -> str:
    """A count in few characters.

    >>> [compact(n) for n in (987, 12_345, 123_456, 2_345_678)]
    ['987', '12.3k', '123k', '2.35M']
    """
    if count < 1000:
        return str(count)
    return f"{count / 1000:.3g}k" if count < 999_500 else f"{count / 1e6:.3g}M"


def duration(seconds: float) -> str:
    """A duration as people write it.

    >>> [duration(s) for s in (7, 72, 3723)]
    ['0:07', '1:12', '1:02:03']
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
