"""What the machine has left for a preparation: memory for threads, room on the disk, and links where it knows them."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

MOST_THREADS = 8
PER_THREAD = 600_000_000  # bytes, for panoramas of 2048 x 1024 and for matching those of any size
LARGEST = 3200 * 1600  # pixels, to which pycolmap reduces larger panoramas
ROOM = 128 << 20  # bytes on the disk, several times what one batch of features or matches writes


def threads_for(width: int, height: int) -> int:
    """One per processor, at most 8 and only as many as free memory allows for panoramas of a size; at least one."""
    each = PER_THREAD * max(1.0, min(width * height, LARGEST) / (2048 * 1024))
    free = free_memory()
    affordable = MOST_THREADS if free is None else int(free / each)
    return max(1, min(MOST_THREADS, os.cpu_count() or 1, affordable))


def free_memory() -> int | None:
    """Bytes that programs can still have, half of all where only that is told, None where nothing is."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            return next(int(line.split()[1]) * 1024 for line in file if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):  # not Linux
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    except (AttributeError, OSError, ValueError):
        return None


def refuse_full(folder: Path) -> None:
    """Raise where the disk of a folder is all but full: pycolmap's threads would end this process without a word.

    Raises:
        OSError: it is.
    """
    if shutil.disk_usage(folder).free < ROOM:
        raise OSError(errno.ENOSPC, f"fewer than {ROOM >> 20} MiB are left on its disk: make room", str(folder))


def link_or_copy(file: Path, place: Path) -> None:
    """Have a file at another place: by a link, or by a copy on disks without links, as exFAT ones are."""
    for link in (place.symlink_to, place.hardlink_to):
        try:
            return link(file.resolve())
        except OSError:
            continue
    shutil.copyfile(file, place)
