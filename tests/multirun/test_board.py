import io
import time
from collections import Counter

import pytest
from rich.console import Console

from padgs.checks import ConfigError
from padgs.multirun import sweep
from padgs.multirun.job import Board, BoardEntry, JobState
from padgs.multirun.sweep import Display, repeated, status_line


def line(*statuses: str, before: dict[str, int] | None = None) -> str:
    return status_line(Counter(before or {}), [JobState(status) for status in statuses], 100.0)


def test_counts_add_up():
    text = line("ok", "oom", "crashed", "oom", "running", "waiting", "elsewhere", before={"ok": 3, "nan": 1})
    assert text.startswith("4 of 11 done (3 before), 4 failed (2 oom, ")
    assert "1 running, 1 waiting, 1 elsewhere" in text


@pytest.mark.parametrize(
    ("statuses", "eta"),
    [
        (("waiting", "running"), None),
        (("ok", "waiting", "running"), "3:20"),
        (("ok", "nan"), None),
    ],
)
def test_the_remaining_time_follows_from_the_speed_since_the_start(statuses, eta):
    text = line(*statuses)
    assert text.endswith(f", ETA {eta}") if eta else "ETA" not in text


@pytest.mark.parametrize("terminal", [False, True])
def test_the_line_is_shown_while_jobs_run(monkeypatch, terminal):
    monkeypatch.setattr(sweep, "SECONDS_BETWEEN_TICKS", 0.01)
    out, shown = io.StringIO(), []
    with Display(Console(file=out, width=100, force_terminal=terminal), redraw=0.0, line=0.05) as display:

        def tick() -> None:
            if display.is_due:
                shown.append(display.show("1 of 2 done"))

        with repeated(tick):
            time.sleep(0.3)
    assert shown and "1 of 2 done" in out.getvalue()


def test_the_board_returns_what_jobs_wrote(tmp_path):
    board = Board(tmp_path / "board")
    assert board.read(3) == JobState() and not board.stop_requested()
    board.write(3, JobState("running", "room", data="/data"))
    assert Board(tmp_path / "board").read(3) == JobState("running", "room", data="/data")
    (board.folder / "00004.json").write_text('{"status": "ok", "ru')
    assert board.read(4) == JobState()


def test_a_stop_reaches_other_processes(tmp_path, monkeypatch):
    mine, theirs = Board(tmp_path), Board(tmp_path)
    assert not theirs.stop_requested()
    mine.request_stop()
    monkeypatch.setattr(theirs, "_looked", -float("inf"))  # a second later
    assert theirs.stop_requested()


def test_a_stop_is_heard_by_its_own_process_even_on_a_full_disk(tmp_path):
    (tmp_path / "taken").touch()
    board = Board(tmp_path / "taken" / "board")
    board.request_stop()
    assert board.stop_requested()


def requeued(folder, run: str | None) -> JobState:
    """Begin a job as Slurm does after each preemption, and return what is on the board; None: it loads its data yet."""
    entry = BoardEntry(Board(folder / "board"), 3)
    if run is not None:
        entry.started(folder / run)
    return Board(folder / "board").read(3)


def test_a_requeued_job_goes_on_with_its_run(tmp_path):
    assert requeued(tmp_path, "room_1") == requeued(tmp_path, "room_1") == JobState("running", "room_1")


@pytest.mark.parametrize("preempted_again", [False, True])
def test_a_requeued_job_that_would_be_another_run_is_refused(tmp_path, preempted_again):
    requeued(tmp_path, "room_1")
    if preempted_again:
        requeued(tmp_path, None)
    with pytest.raises(ConfigError, match=r"began as room_1, and would now be room_2; conf/ or the data have changed"):
        requeued(tmp_path, "room_2")
    assert Board(tmp_path / "board").read(3).run == "room_1"
