import json
import os
import signal
import subprocess
import sys

import pytest

from padgs.runs.store import LOCK, OWNER, RunBusy, RunStore

HOLDER = """
import sys, time
from pathlib import Path
from padgs.runs.store import RunStore
with RunStore(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path, root):
    """Another process that holds the lock."""
    environment = os.environ | {"PYTHONPATH": str(root)}
    command = [sys.executable, "-c", HOLDER, str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def test_only_one_process_gets_it_and_the_other_hears_who_has_it(holder, tmp_path):
    with pytest.raises(RunBusy, match=f"process {holder.pid} on "), RunStore(tmp_path):
        pytest.fail("two processes work on one run")
    (tmp_path / OWNER).write_text("{}")
    with pytest.raises(RunBusy, match="worked on by another process"), RunStore(tmp_path):
        pass


def test_the_lock_of_a_dead_process_is_free(holder, tmp_path):
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    assert json.loads((tmp_path / OWNER).read_text())["pid"] == holder.pid  # it could not tidy up
    with RunStore(tmp_path):
        assert json.loads((tmp_path / OWNER).read_text())["pid"] == os.getpid()
    assert not (tmp_path / OWNER).exists()
    with pytest.raises(ZeroDivisionError), RunStore(tmp_path):
        raise ZeroDivisionError
    with RunStore(tmp_path):
        assert (tmp_path / LOCK).exists()


def test_a_folder_that_cannot_be_locked_is_busy_only_if_it_has_an_owner(tmp_path, monkeypatch):
    store = RunStore(tmp_path)
    monkeypatch.setattr(store._lock, "acquire", lambda **_: (_ for _ in ()).throw(PermissionError(13, "read-only")))
    assert not store.is_busy
    (tmp_path / OWNER).write_text("{}")
    assert store.is_busy
