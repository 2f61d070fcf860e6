"""Work."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from padgs.data.assemble import STATEMENT
from padgs.data.capture import DataError
from padgs.data.masks import mask_place
from padgs.data.prepare.sfm import PAIRS
from padgs.data.prepare.sources import find_source, is_video

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


@dataclass(frozen=True)
class PrepareOptions:
    """What the user may decide."""

    accurate: bool = False  # features in undistorted views: slower, better near the poles
    pairs: str = "auto"  # auto | exhaustive | sequential (names in the order they were taken)
    mask: str = "auto"  # auto (mask.png or masks/ with the images) | none | rows:959/1024 | a file or folder
    level: bool = True  # turn the world so that the cameras' common up is +z
    per_second: float = 2.0  # frames kept of a video
    seed: int = 0
    threads: int = 0  # 0 = one per processor, at most 8 and as many as free memory allows

    def __post_init__(self) -> None:
        if self.pairs not in PAIRS:
            raise DataError(f"unknown pairs {self.pairs!r}; known: {', '.join(PAIRS)}")
        if not 0 < self.per_second <= 1000:
            raise DataError(f"per_second is {self.per_second}; it must be above 0 and at most 1000 frames a second")
        if self.threads < 0:
            raise DataError(f"threads is {self.threads}; give 1 or more, or 0 for what this machine allows")


@dataclass
class Prepared:
    """What came out; also in prepare.json at the destination."""

    folder: Path
    registered: tuple[str, ...]
    unregistered: tuple[str, ...]  # images that could not be placed; they are not at the destination
    points: int
    observations: int
    seconds: dict[str, float] = field(default_factory=dict)  # per step, of this call
    notes: tuple[str, ...] = ()

    def write(self, folder: Path, options: PrepareOptions, digest: str) -> None:
        """State it in a folder; `digest` is of the input, see `digest_of`."""
        stated = {**asdict(self), "folder": ".", "options": asdict(options), "input": digest}
        (folder / STATEMENT).write_text(json.dumps(stated, indent=2, ensure_ascii=False), encoding="utf-8")


def finished(source: Path, destination: Path, options: PrepareOptions) -> Prepared | None:
    """What an earlier call made of the same input with the same options."""
    try:
        stated = json.loads((destination / STATEMENT).read_text(encoding="utf-8"))
        if stated["input"] != digest_of(fingerprint(source, options), options):
            return None
        known: dict[str, Any] = {field.name: stated[field.name] for field in fields(Prepared) if field.name != "folder"}
    except (OSError, ValueError, KeyError, TypeError):
        return None
    lists = {name: tuple(known[name]) for name in ("registered", "unregistered", "notes")}
    known |= {**lists, "seconds": {}}
    return Prepared(destination, **known)


def fingerprint(source: Path, options: PrepareOptions) -> str:
    """Of images with their masks; of a video and the files of its mask, since its frames are gone in the end."""
    if not is_video(source):
        return find_source(source, options.mask).fingerprint
    digests, mask = [_file_digest(source)], mask_place(options.mask, Path())
    if mask is not None:
        files = sorted(file for file in (mask, *mask.rglob("*")) if file.is_file())
        digests += [f"{file.relative_to(mask)}:{_file_digest(file)}" for file in files]
    return "|".join(digests)


def digest_of(fingerprint: str, options: PrepareOptions) -> str:
    """Of an input and all that decides what becomes of it."""
    wanted = {key: value for key, value in asdict(options).items() if key != "threads"}
    return hashlib.sha256(json.dumps([fingerprint, wanted], sort_keys=True).encode()).hexdigest()


def _file_digest(path: Path) -> str:
    digest = hashlib.sha256()
    try:
        with open(path, "rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}); check its name and permissions") from error
    return digest.hexdigest()


class WorkFolder:
    """Steps that are done once in a folder, each with a marker, `STEP.done`.

    Attributes:
        path: of the folder.
        seconds: name of a step -> what it took in this process.
    """

    def __init__(self, path: Path) -> None:
        """Of a folder that need not be there yet."""
        self.path, self.seconds = path, dict[str, float]()

    def open(self, of: str, digest: str, keep: tuple[str, ...] = ()) -> None:
        """Go on with what is there of the same digest; start over, but for `keep`, with any other."""
        marker = self.path / f"{of}.sha256"
        if not (marker.is_file() and marker.read_text() == digest):
            for path in self.path.iterdir() if self.path.is_dir() else ():
                if path.name not in keep:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
        self.path.mkdir(parents=True, exist_ok=True)
        marker.write_text(digest)

    def empty(self, name: str) -> Path:
        """A folder within it, with nothing in that."""
        folder = self.path / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        return folder

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Note how long a step takes."""
        start = time.perf_counter()
        yield
        self.seconds[name] = round(time.perf_counter() - start, 2)

    def once(self, step: str, action: Callable[[], None]) -> None:
        """Do a step unless it has been done in this folder.

        Raises:
            DataError: the disk is full.
        """
        marker = self.path / f"{step}.done"
        with self.step(step):
            if not marker.exists():
                refuse_full(self.path)
                action()
                marker.touch()
