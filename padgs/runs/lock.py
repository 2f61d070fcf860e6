"""Two processes never work on the same run: a lock that dies with its process, and a note about who holds it."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

LOCK, OWNER = ".lock", ".owner.json"  # in the run folder


class RunBusy(RuntimeError):
    """Another process works on this run; the message says which."""


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold the lock of a run folder, without waiting for it.

    It is the kernel's lock on an open file, so there is no stale one: when a process dies, however, its locks are free.
    Where the file system has no such locks, `filelock` falls back to the existence of the file, with host and process
    number in it, and takes over from a process of this host that is dead.

    Raises:
        RunBusy: another process holds it.
        OSError: the folder cannot be written.
    """
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise RunBusy(f"{folder} is being worked on by {_owner(folder)}; it is left alone") from error
    try:
        now = datetime.now(timezone.utc).isoformat(timespec="seconds")
        (folder / OWNER).write_text(json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "since": now}))
        yield
        with suppress(OSError):
            (folder / OWNER).unlink()
    finally:
        lock.release()


def _owner(folder: Path) -> str:
    try:
        known: dict[str, Any] = json.loads((folder / OWNER).read_text())
        return f"process {known['pid']} on {known['host']} since {known['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"
