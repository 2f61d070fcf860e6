import errno
import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from padgs import results
from padgs.files import DRAFT, LONGEST, atomic_path, draft_of, file_name, read_regular, write_atomically
from padgs.runs import checkpoint

KILLED = """
import os, signal, sys
from pathlib import Path
from padgs.files import atomic_path, draft_of
folder = Path(sys.argv[1])
with atomic_path(folder / "splats.ply") as file, draft_of(folder / "frames") as images:
    file.write_text("half of")
    images.mkdir()
    (images / "1.png").write_text("")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_file_is_replaced_when_the_new_one_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "room.compressed.ply"
    path.write_text("the earlier one")
    with pytest.raises(KeyboardInterrupt), atomic_path(path) as draft:
        draft.write_text("half of")
        raise KeyboardInterrupt
    assert path.read_text() == "the earlier one"
    with atomic_path(path) as draft:
        assert draft.name.endswith(".compressed.ply") and draft.name.startswith(".")
        draft.write_text("the new one")
        assert path.read_text() == "the earlier one"
    assert path.read_text() == "the new one" and list(tmp_path.iterdir()) == [path]


def test_drafts_of_killed_processes_are_removed_a_day_later(tmp_path: Path) -> None:
    killed = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)])
    left = list(tmp_path.iterdir())
    assert killed.returncode == -signal.SIGKILL and len(left) == 2
    others = {tmp_path / name for name in (f"{DRAFT}another-host-1-x", "video.mp4", ".hidden")}
    for path in others:
        path.write_text("")
    for path in left:
        os.utime(path, (0, 0))
    with draft_of(tmp_path / "in work") as work, atomic_path(tmp_path / "points.ply") as draft:
        work.mkdir()
        draft.write_text("")
    assert {*tmp_path.iterdir()} == {*others, tmp_path / "points.ply"}


def test_long_names_leave_room_for_the_draft(tmp_path: Path) -> None:
    path = tmp_path / f"{'n' * 240}.ply"
    with atomic_path(path) as draft:
        draft.write_text("")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["result.json", "log.jsonl", "checkpoint/state.json"])
def test_pipes_in_place_of_files_of_a_run_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "checkpoint").mkdir()
    os.mkfifo(tmp_path / name)
    with pytest.raises(OSError, match="no regular file"):
        read_regular(tmp_path / name)
    assert list(results.log_lines(tmp_path)) == []
    with pytest.raises(results.ResultError, match=r"cannot read .*result.json: (it is no regular|No such) file"):
        results.read(tmp_path / "result.json")
    with pytest.raises(checkpoint.CheckpointError, match=r"cannot read .*state.json: (it is no regular|No such) file"):
        checkpoint.load(tmp_path / "checkpoint")


def test_a_file_is_written_where_folders_cannot_be_forced_to_the_disk(tmp_path, monkeypatch):
    force = os.fsync

    def only_files(number):
        if stat.S_ISDIR(os.fstat(number).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        force(number)

    monkeypatch.setattr(os, "fsync", only_files)
    write_atomically(tmp_path / "a", b"all")
    assert (tmp_path / "a").read_bytes() == b"all"


@pytest.mark.parametrize("letter", ["a", "室"])
def test_long_names_are_cut_and_stay_apart(letter):
    """File systems take 255 bytes with an ending."""
    names = [file_name(f"{letter * 300}/{last}") for last in "xy"]
    assert names[0] != names[1] and all(len(name.encode()) <= LONGEST for name in names)
    assert file_name(letter * 60) == letter * 60
