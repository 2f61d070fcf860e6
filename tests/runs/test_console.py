"""Output on a terminal, and what reaches none."""

import errno
import io
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rich.console import Console
from support.composed import composed
from support.made_up import result
from support.tiny_scene import tiny_scene

from padgs.runs import console as run_console
from padgs.runs.console import LiveLine, introduce, say, show_result
from padgs.training.loop import Record

TEXT = "[bold]a[/b] [/x] \x1b[2J \x1b]0;t\x07 \udce9"
SHOWN = r"[bold]a[/b] [/x] \x1b[2J \x1b]0;t\x07 \udce9"


@pytest.mark.parametrize(
    "write",
    [
        lambda console: say(console, TEXT),
        lambda console: introduce(replace(composed(), variant=TEXT), tiny_scene(), Path("x"), console),
        lambda console: introduce(composed(), replace(tiny_scene(), name=TEXT), Path("x"), console),
        lambda console: introduce(composed(), replace(tiny_scene(), notes=(TEXT,)), Path("x"), console),
        lambda console: introduce(composed(), tiny_scene(), Path(TEXT), console),
        lambda console: show_result(replace(result(), status="nan", reason=TEXT), Path("x"), console),
    ],
)
def test_names_are_neither_markup_nor_obeyed(write):
    out = io.StringIO()
    write(Console(file=out, width=400, force_terminal=True, color_system=None))
    assert SHOWN in out.getvalue() and "\x1b" not in out.getvalue()


def lines(monkeypatch, *, terminal: bool, seconds_per_iteration: float = 2.0, iterations: int = 12) -> str:
    """What is shown of a run that takes so long."""
    now = [0.0]
    monkeypatch.setattr(run_console.time, "monotonic", lambda: now[0])
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=200, color_system=None)
    with LiveLine(console) as line:
        for iteration in range(1, iterations + 1):
            now[0] += seconds_per_iteration
            record = Record(iteration, iteration / iterations, 0.25, 0.0, 0.0, {"anchors": 1234})
            line.update(record, 21.5 if iteration == 4 else None)
    return out.getvalue()


def test_without_a_terminal_a_line_every_ten_seconds_and_the_last(monkeypatch):
    shown = lines(monkeypatch, terminal=False).splitlines()
    assert [line.split("%  ")[1].split()[0] for line in shown] == ["1", "6", "11", "12"]
    assert shown[1] == "ETA 0:12  ████░░░░  50%  6  loss 0.2500  21.50 dB  1.23k anchors  0.5 it/s"
    assert "dB" not in shown[0] and shown[0].startswith("ETA –  █░░░░░░░   8%")
    assert max(map(len, shown)) <= 80


@pytest.mark.parametrize("number", [errno.EPIPE, errno.EIO])
def test_output_that_nobody_reads_ends_nothing(number):
    class Closed(io.StringIO):
        def write(self, text):
            raise OSError(number, "nobody reads")

    console = Console(file=Closed(), width=80)
    say(console, "one")
    with LiveLine(console) as line:
        line.update(Record(1, 1.0, 0.25, 0.0, 0.0, {}), None)


def test_a_terminal_has_one_line_that_changes(monkeypatch):
    shown = lines(monkeypatch, terminal=True)
    assert "  8%  1  loss" in shown and "100%  12  loss" in shown
    assert shown.count("\n") <= 1


def test_the_last_loss_that_was_read_is_shown_while_others_wait_for_a_gpu():
    """Reading one would stop the GPU beside the clock of training; a tensor on meta raises instead."""
    out, unread = io.StringIO(), torch.zeros((), device="meta")
    with LiveLine(Console(file=out, width=200)) as line:
        for iteration, loss in enumerate((unread, 0.25, unread, unread), 1):
            line.update(Record(iteration, iteration / 4, loss, 0.0, 0.0, {}), None)
    assert re.findall(r"%  (\d)(  loss \S+)?", out.getvalue()) == [("1", ""), ("4", "  loss 0.2500")]
