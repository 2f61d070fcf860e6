"""Generated scenes on disk, by content hash of their configuration and of the generator itself.

The folder is $PADGS_CACHE, or ~/.cache/padgs. One scene is one folder of PNGs and `scene.npz`, written beside its
final place and then renamed, so a reader never sees half of one. Where nothing can be written there is no cache.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import zlib
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from PIL import Image

from padgs.data.synthetic.options import SyntheticOptions
from padgs.data.synthetic.textures import Array


@dataclass(frozen=True)
class Stored:
    """What generating costs time to make: everything that a Scene holds, in world units."""

    images: list[Array] | list[Path]  # of all views along the path: [H, W, 3] uint8, or where their PNGs lie
    poses: Array  # [n, 4, 4] cam_from_world as given to methods, noise included
    points: Array  # [P, 3]
    colors: Array  # [P, 3] uint8
    fingerprint: str


def folder() -> Path:
    """Where generated scenes are kept."""
    named = os.environ.get("PADGS_CACHE")
    return (Path(named) if named else Path.home() / ".cache" / "padgs") / "synthetic"


def key(options: SyntheticOptions) -> str:
    """Content hash of a configuration and of the code that turns it into pixels."""
    digest = hashlib.sha256(json.dumps(asdict(options), sort_keys=True).encode())
    digest.update(_source())
    return digest.hexdigest()[:24]


@cache
def _source() -> bytes:
    return b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))


def read(options: SyntheticOptions) -> Stored | None:
    """The stored scene of a configuration, or None if there is none, or a damaged one."""
    place = folder() / key(options)
    try:
        # Opened here, because numpy leaves a file that is not a zip archive open.
        with open(place / "scene.npz", "rb") as file, np.load(file, allow_pickle=False) as table:
            count = len(table["poses"])
            images = [place / f"{index:03d}.png" for index in range(count)]
            if not all(path.is_file() for path in images):
                return None
            return Stored(images, table["poses"], table["points"], table["colors"], str(table["fingerprint"]))
    except (OSError, KeyError, ValueError, EOFError, BadZipFile, zlib.error):
        return None


def write(options: SyntheticOptions, stored: Stored) -> str | None:
    """Keep a scene; returns why not, where that is impossible."""
    place = folder() / key(options)
    draft = None
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=place.parent))
        for index, image in enumerate(stored.images):
            assert isinstance(image, np.ndarray)
            Image.fromarray(image).save(draft / f"{index:03d}.png", compress_level=2)
        arrays = {name: getattr(stored, name) for name in ("poses", "points", "colors", "fingerprint")}
        np.savez_compressed(draft / "scene.npz", **arrays)
        draft.chmod(0o755)
        if place.exists() and read(options) is None:
            shutil.rmtree(place)  # damaged
        draft.rename(place)
    except OSError as error:
        if place.exists() and read(options) is not None:
            return None  # somebody else was faster
        return f"generated scene not cached: {error}; set PADGS_CACHE to a folder that can be written"
    finally:
        if draft is not None:
            shutil.rmtree(draft, ignore_errors=True)
    return None
