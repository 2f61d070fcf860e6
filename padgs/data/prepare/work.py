"""State of a preparation: options, result, the hidden working folder that can be resumed, and the machine's resources.

prepare.json, at the destination, records options and result, by which a finished preparation is recognised.
"""

import errno
import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from padgs.checks import check, check_known
from padgs.clock import cores, linux_value
from padgs.data.assemble import PREPARED
from padgs.data.capture import DataError, first_of
from padgs.data.masks import SCENE_MASKS, mask_digests, mask_path
from padgs.data.metres import KnownLength
from padgs.data.prepare.pairs import PAIRS
from padgs.data.prepare.sfm import MAPPERS
from padgs.data.prepare.sources import find_source, is_video

PER_SECOND = 2.0
LOCK = ".lock"  # of the process that works in the folder
MAX_THREADS = 8
MEMORY_PER_THREAD = 600_000_000  # bytes, for panoramas of 2048 x 1024, and for matching any size
CGROUP = Path("/sys/fs/cgroup")
MAX_SIDE = 3200  # pixels; pycolmap reduces larger images to this
MIN_FREE_DISK = 128 << 20  # bytes, several times the output of a batch of features or matches


def threads_for(width: int, height: int) -> int:
    """Return the number of threads for images of a size: one per processor, at most 8, limited by free memory."""
    pixels = width * height * min(1.0, MAX_SIDE / max(width, height)) ** 2
    each = MEMORY_PER_THREAD * max(1.0, pixels / (2048 * 1024))
    free = free_memory()
    affordable = MAX_THREADS if free is None else int(free / each)
    return max(1, min(MAX_THREADS, cores(), affordable))


def free_memory() -> int | None:
    """Return the free memory in bytes, of a container's limit too; None where that is not known."""
    kilobytes = linux_value("/proc/meminfo", "MemAvailable").partition(" ")[0]
    free = [1024 * int(kilobytes)] if kilobytes else []
    with suppress(OSError, ValueError, KeyError):  # there is no cgroup, or its limit is "max"
        statistics = dict(line.split() for line in (CGROUP / "memory.stat").read_text().splitlines())
        used = int((CGROUP / "memory.current").read_text()) - int(statistics["file"])  # the page cache can be freed
        free.append(max(0, int((CGROUP / "memory.max").read_text()) - used))
    return min(free, default=None)


def refuse_full(folder: Path) -> None:
    """Refuse by an OSError to work on a nearly full disk, where pycolmap's threads would kill the process silently."""
    if shutil.disk_usage(folder).free < MIN_FREE_DISK:
        reason = f"less than {MIN_FREE_DISK >> 20} MiB is left on its disk: free some space"
        raise OSError(errno.ENOSPC, reason, str(folder))


def link_or_copy(file: Path, target: Path) -> None:
    """Link a file, or copy it on file systems without links, such as exFAT."""
    try:
        target.symlink_to(file.resolve())
    except OSError:
        shutil.copyfile(file, target)


@dataclass(frozen=True)
class PrepareOptions:
    """Options of `padgs prepare`."""

    accurate: bool = False  # features in perspective views: slower, better near the poles
    pairs: str = "auto"  # auto | exhaustive | sequential (names in the order they were taken) | similar
    mask: str = "auto"  # auto (mask.png or masks/ with the images) | none | rows:959/1024 | a file or folder
    level: bool = True  # rotate the world so that the cameras' common up is +z
    per_second: float = PER_SECOND  # frames kept of a video
    seed: int = 0
    mapper: str = "incremental"  # incremental | global
    known: KnownLength = KnownLength()  # sets the scale of the world
    threads: int = 0  # 0 = one per processor, at most 8, limited by free memory

    def __post_init__(self) -> None:
        check_known(self, pairs=PAIRS, mapper=MAPPERS)
        check(self, "above 0 and at most 1000 frames a second", lambda rate: 0 < rate <= 1000, "per_second")
        check(self, "at least 1, or 0 for automatic", lambda count: count >= 0, "threads")


@dataclass
class Prepared:
    """Result of a preparation; also written to prepare.json."""

    folder: Path
    registered: tuple[str, ...]
    unregistered: tuple[str, ...]  # images without a pose; they are not copied
    points: int
    observations: int
    seconds: dict[str, float] = field(default_factory=dict)  # per step
    notes: tuple[str, ...] = ()

    def write(self, folder: Path, options: PrepareOptions, digest: str) -> None:
        """Write prepare.json to a folder that has its masks; `digest` identifies the input, see `digest_of`."""
        record = {**asdict(self), "folder": ".", "options": asdict(options), "input": digest}
        record["masks"] = mask_digests(folder)
        (folder / PREPARED).write_text(json.dumps(record, indent=2, ensure_ascii=False), encoding="utf-8")


def check_options(source: Path, options: PrepareOptions) -> None:
    """Refuse options that this kind of input does not have, by a DataError."""
    if not is_video(source):
        if options.per_second != PER_SECOND:
            raise DataError(f"--per-second {options.per_second:g}: {source} is no video; leave it out")
    elif options.mask == "auto" and (beside := first_of(source.parent, SCENE_MASKS)):
        raise DataError(f"{beside} lies beside the video: use it with --mask {beside}, or not with --mask none")
    elif options.mask == "inverted":
        raise DataError("--mask inverted: a video has no masks of its own; give their path: --mask inverted:PATH")
    elif options.known.gps:
        raise DataError("--gps: frames of a video have no GPS; use --metres A B DISTANCE or --camera-height")


def find_result(source: Path, destination: Path, options: PrepareOptions) -> Prepared | None:
    """Return the result of an earlier call with the same input and options, if there is one."""
    given = digest_of(fingerprint(source, options), options)
    try:
        record = json.loads((destination / PREPARED).read_text(encoding="utf-8"))
        if record["input"] != given:
            return None
        registered, unregistered, notes = (tuple(record[name]) for name in ("registered", "unregistered", "notes"))
        return Prepared(destination, registered, unregistered, record["points"], record["observations"], notes=notes)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def fingerprint(source: Path, options: PrepareOptions) -> str:
    """Return a digest of images with masks, or of a video and its mask files, since its frames are deleted."""
    if not is_video(source):
        return find_source(source, options.mask).fingerprint
    digests, mask = [_file_digest(source)], mask_path(options.mask.removeprefix("inverted:"), Path())
    if mask is not None:
        if not mask.exists():
            raise DataError(f"--mask {options.mask}: no such file or folder")
        files = sorted(file for file in (mask, *mask.rglob("*")) if file.is_file())
        digests += [f"{file.relative_to(mask)}:{_file_digest(file)}" for file in files]
    return "|".join(digests)


def digest_of(fingerprint: str, options: PrepareOptions, without: Sequence[str] = ("threads",)) -> str:
    """Return a digest of an input and all options that affect the result."""
    relevant = {key: value for key, value in asdict(options).items() if key not in without}
    return hashlib.sha256(json.dumps([fingerprint, relevant], sort_keys=True).encode()).hexdigest()


def _file_digest(path: Path) -> str:
    digest = hashlib.sha256()
    try:
        if not path.is_file() and path.exists():
            raise OSError(0, "it is no regular file")
        with open(path, "rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}); check its name and permissions") from error
    return digest.hexdigest()


class WorkFolder:
    """Working folder, which need not exist, in which each step runs once, with the marker file `STEP.done`."""

    def __init__(self, path: Path) -> None:
        self.path, self.seconds = path, dict[str, float]()  # seconds: duration of each step in this process

    def open(self, kind: str, digest: str, keep: tuple[str, ...] = ()) -> None:
        """Resume if the folder has the same digest of this kind of input; else delete all but `keep`."""
        marker = self.path / f"{kind}.sha256"
        if not (marker.is_file() and marker.read_text() == digest):
            marker.unlink(missing_ok=True)  # first, so that nothing resumes where only a part is deleted
            for path in self.path.iterdir() if self.path.is_dir() else ():
                if path.name not in (*keep, LOCK):
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
        self.path.mkdir(parents=True, exist_ok=True)
        marker.write_text(digest)

    def empty(self, name: str) -> Path:
        """Create an empty subfolder."""
        folder = self.path / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        return folder

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Record the duration of a step."""
        start = time.perf_counter()
        yield
        self.seconds[name] = round(time.perf_counter() - start, 2)

    def run_once(self, step: str, action: Callable[[], None], way: str = "") -> None:
        """Run a step unless its marker says that it ran in this way; an OSError if the disk is full."""
        marker = self.path / f"{step}.done"
        with self.step(step):
            if not (marker.exists() and marker.read_text() == way):
                refuse_full(self.path)
                action()
                marker.write_text(way)
