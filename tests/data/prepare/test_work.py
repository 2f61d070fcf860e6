"""Resources of the machine: threads by free memory, full disks, and file systems without links."""

import errno
import os
from pathlib import Path

import pytest

from padgs.data.prepare import work


def test_threads_are_limited_by_free_memory(monkeypatch):
    assert work.free_memory() > 50_000_000
    monkeypatch.setattr(os, "cpu_count", lambda: 12)
    free = {"bytes": 2_000_000_000}
    monkeypatch.setattr(work, "free_memory", lambda: free["bytes"])
    assert work.threads_for(2048, 1024) == work.threads_for(512, 256) == 3
    assert work.threads_for(4096, 2048) == work.threads_for(8192, 4096) == 1
    for free["bytes"] in (None, 64_000_000_000):
        assert work.threads_for(2048, 1024) == 8
    free["bytes"] = 1
    assert work.threads_for(2048, 1024) == 1


def test_files_are_copied_on_file_systems_without_links(tmp_path, monkeypatch):
    original = tmp_path / "original.png"
    original.write_bytes(b"a picture")
    link, copy = tmp_path / "link", tmp_path / "copy"

    def refuse(*args, **kwargs):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    work.link_or_copy(original, link)
    monkeypatch.setattr(Path, "symlink_to", refuse)
    work.link_or_copy(link, copy)
    assert link.is_symlink() and not copy.is_symlink() and not copy.samefile(original)
    assert copy.read_bytes() == b"a picture"


def test_a_full_disk_is_refused(tmp_path, monkeypatch):
    work.refuse_full(tmp_path)
    monkeypatch.setattr(work, "MIN_FREE_DISK", 1 << 60)
    with pytest.raises(OSError, match="MiB is left on its disk: free some space") as refused:
        work.refuse_full(tmp_path)
    assert refused.value.errno == errno.ENOSPC
