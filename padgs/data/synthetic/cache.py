"""Disk cache of generated scenes, keyed by a hash of their options and of the generator's source code.

The folder is $PADGS_CACHE, or ~/.cache/padgs. A scene is a folder of PNGs, `scene.npz` and the digest of both. It is
written to a temporary folder and then renamed, so that readers never see incomplete scenes. A scene that does not fit
its digest is generated again. Without write access there is no cache.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from padgs.data.synthetic.options import SyntheticOptions
from padgs.data.synthetic.textures import Array
from padgs.files import draft_of


@dataclass(frozen=True)
class Stored:
    """Generated data of a Scene, in world units."""

    images: list[Array] | list[Path]  # of all views along the path: [H, W, 3] uint8, or PNG files
    poses: Array  # [n, 4, 4] cam_from_world with pose noise
    points: Array  # [P, 3]
    colors: Array  # [P, 3] uint8
    fingerprint: str


def folder() -> Path:
    """Return the folder of the cache."""
    named = os.environ.get("PADGS_CACHE")
    return (Path(named) if named else Path.home() / ".cache" / "padgs") / "synthetic"


def key(options: SyntheticOptions) -> str:
    """Return a hash of the options and of the code that generates scenes."""
    digest = hashlib.sha256(json.dumps(asdict(options), sort_keys=True).encode())
    digest.update(_source())
    return digest.hexdigest()[:24]


@cache
def _source() -> bytes:
    return b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.iterdir()) if path.is_file())


def _digest(entry: Path) -> str:
    digest = hashlib.sha256()
    for file in sorted(entry.glob("*.*")):
        digest.update(f"{file.name}|".encode() + file.read_bytes())
    return digest.hexdigest()


def read(options: SyntheticOptions) -> Stored | None:
    """Read a cached scene; None if it is missing or was changed."""
    entry = folder() / key(options)
    try:
        if (entry / "sha256").read_text() != _digest(entry):
            return None
        with np.load(entry / "scene.npz", allow_pickle=False) as table:
            images, fingerprint = sorted(entry.glob("*.png")), str(table["fingerprint"])
            return Stored(images, table["poses"], table["points"], table["colors"], fingerprint)
    except (OSError, ValueError):
        return None


def write(options: SyntheticOptions, stored: Stored) -> str | None:
    """Cache a scene; returns the reason if that is impossible."""
    entry = folder() / key(options)
    try:
        entry.parent.mkdir(parents=True, exist_ok=True)
        with draft_of(entry) as draft:
            draft.mkdir()
            for index, image in enumerate(stored.images):
                assert isinstance(image, np.ndarray)
                Image.fromarray(image).save(draft / f"{index:06d}.png", compress_level=2)
            arrays = {name: getattr(stored, name) for name in ("poses", "points", "colors", "fingerprint")}
            np.savez_compressed(draft / "scene.npz", **arrays)
            (draft / "sha256").write_text(_digest(draft))
            if entry.exists() and read(options) is None:
                shutil.rmtree(entry)  # changed or damaged
            draft.rename(entry)
    except OSError as error:
        if read(options) is not None:
            return None  # another process was faster
        return f"generated scene not cached: {error}; set PADGS_CACHE to a folder that can be written"
    return None
