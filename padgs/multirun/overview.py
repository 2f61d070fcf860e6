"""A multirun at a glance: how many runs are done, running and failed, what the running ones do, and the time left."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from padgs import results
from padgs.multirun.board import ELSEWHERE, OK, RUNNING, STOPPED, WAITING, JobState
from padgs.runs.console import Display, duration

SECONDS_BETWEEN_LOOKS = 1.0
SECONDS_BETWEEN_LINES = 30.0  # where there is no terminal
SHOWN = 8  # running jobs
TAIL = 1000  # bytes at the end of a log that hold its last line; 344 kB of 64 runs each second would be 0.4 s of work


@dataclass(frozen=True)
class Overview:
    """The state of a multirun at one moment."""

    before: Counter[str]  # status -> runs that were finished when it started
    jobs: Mapping[int, JobState]
    seconds: float  # since it started
    progress: Mapping[int, float]  # job -> share of its training, for those that run

    @property
    def counts(self) -> Counter[str]:
        """Status -> number of runs, those finished before included."""
        return self.before + Counter(state.status for state in self.jobs.values())

    @property
    def seconds_left(self) -> float | None:
        """From the speed so far, all runs counted alike; None before anything is known."""
        left = sum(state.status in (WAITING, RUNNING) for state in self.jobs.values())
        ran = sum(state.finished for state in self.jobs.values()) + sum(self.progress.values())
        return self.seconds * (left - sum(self.progress.values())) / ran if ran else None

    def line(self) -> str:
        """One line for people.

        >>> jobs = {0: JobState("ok"), 1: JobState("nan"), 2: JobState("running"), 3: JobState()}
        >>> Overview(Counter(ok=2), jobs, 60.0, {2: 0.5}).line()
        '3 of 6 done (2 before), 1 failed (nan), 1 running, 1 waiting, ETA 0:36'
        """
        counts = self.counts
        done, earlier = counts.pop(OK, 0), self.before[OK]
        parts = [f"{done} of {counts.total() + done} done" + (f" ({earlier} before)" if earlier else "")]
        neutral = {name: counts.pop(name, 0) for name in (RUNNING, WAITING, ELSEWHERE, STOPPED)}
        if counts.total():
            statuses = [name if number == 1 else f"{number} {name}" for name, number in counts.most_common()]
            parts.append(f"{counts.total()} failed ({', '.join(statuses)})")
        parts += [f"{number} {name}" for name, number in neutral.items() if number]
        if neutral[RUNNING] + neutral[WAITING] and self.seconds_left is not None:
            parts.append(f"ETA {duration(self.seconds_left)}")
        return ", ".join(parts)

    def screen(self) -> Table:
        """The line with a bar above it and the running jobs below."""
        counts = self.counts
        ended = sum(number for status, number in counts.items() if status not in (WAITING, RUNNING))
        running = [
            Text(f"  {Path(state.run).name or 'starting'}  {100 * self.progress.get(job, 0):.0f} %", style="dim")
            for job, state in self.jobs.items()
            if state.status == RUNNING
        ]
        bar = ProgressBar(total=max(counts.total(), 1), completed=ended + sum(self.progress.values()))
        table = Table.grid()
        for row in (bar, Text(self.line()), *running[:SHOWN]):
            table.add_row(row)
        return table


def share_done(run: Path) -> float:
    """The share of its training that a run has behind it by the last line of its log; 0 if there is none."""
    return max((line.get("progress", 0.0) for line in results.log_lines(run, TAIL)), default=0.0)


@contextmanager
def shown(look: Callable[[], Overview], also: Callable[[], None], console: Console) -> Iterator[None]:
    """While jobs run in other processes: look at them every second, and show what is seen.

    Args:
        look: what there is to see.
        also: done at every look, in the thread that looks.
        console: of a terminal: a live picture; else a line every half minute.
    """
    over = threading.Event()
    with Display(console, redraw=0.0, line=SECONDS_BETWEEN_LINES) as display:

        def show() -> None:
            seen = look()
            display.show(seen.line(), seen.screen())

        def watch() -> None:
            while not over.wait(SECONDS_BETWEEN_LOOKS):
                also()
                if display.is_due:
                    show()

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
            if console.is_terminal:
                show()
