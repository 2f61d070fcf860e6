"""What a preparation was asked for and what came out, stated in prepare.json, by which it is known again."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from padgs.data.assemble import STATEMENT
from padgs.data.errors import DataError
from padgs.data.masks import mask_place
from padgs.data.prepare.pairs import PAIRS
from padgs.data.prepare.sources import find_source
from padgs.data.prepare.video import is_video


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
