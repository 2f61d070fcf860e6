import io
import time
from collections import Counter

import pytest
from rich.console import Console

from padgs.multirun import overview
from padgs.multirun.board import Board, JobState
from padgs.multirun.overview import Overview, share_done, shown


def seen(*statuses: str, before: dict[str, int] | None = None, progress: dict[int, float] | None = None) -> Overview:
    states = {number: JobState(status) for number, status in enumerate(statuses)}
    return Overview(Counter(before or {}), states, 100.0, progress or {})


def test_counts_add_up():
    line = seen("ok", "oom", "crashed", "oom", "running", "waiting", "elsewhere", before={"ok": 3, "nan": 1}).line()
    assert line.startswith("4 of 11 done (3 before), 4 failed (2 oom, ")
    assert "1 running, 1 waiting, 1 elsewhere" in line


def test_time_left_follows_from_what_was_done_since_the_start():
    assert seen("waiting", "running").seconds_left is None
    assert seen("ok", "waiting", "waiting").seconds_left == pytest.approx(200)
    assert seen("ok", "running", "running", progress={1: 0.5, 2: 0.5}).seconds_left == pytest.approx(50)
    assert seen("ok", "nan", before={"ok": 100}).seconds_left == 0
    assert "ETA" not in seen("ok", "nan").line()


def test_progress_is_the_last_whole_line_of_the_log(tmp_path):
    assert share_done(tmp_path) == 0
    lines = (f'{{"iteration": {n}, "progress": {n / 200}}}\n' for n in range(1, 200))
    (tmp_path / "log.jsonl").write_text("".join(lines))
    assert share_done(tmp_path) == 199 / 200


def test_without_a_terminal_there_is_a_line_now_and_then(monkeypatch):
    monkeypatch.setattr(overview, "SECONDS_BETWEEN_LOOKS", 0.01)
    monkeypatch.setattr(overview, "SECONDS_BETWEEN_LINES", 0.05)
    out, looks = io.StringIO(), []
    with shown(lambda: seen("ok", "waiting"), lambda: looks.append(1), Console(file=out, width=100)):
        time.sleep(0.3)
    assert out.getvalue().splitlines()[0] == "1 of 2 done, 1 waiting, ETA 1:40"
    assert len(looks) > len(out.getvalue().splitlines()) >= 1


def test_in_a_terminal_the_picture_is_live_and_the_last_one_stays():
    out = io.StringIO()
    states = {0: JobState("running", run="room_padgs_1")}
    final = Overview(Counter(), states, 1.0, {0: 0.4})
    with shown(lambda: final, lambda: None, Console(file=out, width=100, force_terminal=True)):
        pass
    assert "room_padgs_1  40 %" in out.getvalue() and "0 of 1 done, 1 running" in out.getvalue()


def test_the_board_says_what_jobs_wrote_and_nothing_more(tmp_path):
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
