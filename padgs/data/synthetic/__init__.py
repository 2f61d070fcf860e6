"""Synthetic scenes with exact ground truth: an analytic world, ray-cast into panoramas.

`generate(SyntheticOptions()) -> Scene` renders (or reads from the cache) panoramas, poses and a noisy point cloud;
`SyntheticTruth` gives exact depth and poses. World frame: z up, x and y horizontal,
one unit per metre unless `world_scale` changes that.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from padgs.checks import ConfigError, typed
from padgs.data.capture import DataError, DataOptions
from padgs.data.store import ImageStore, StoredImage, cache_root
from padgs.data.synthetic import camera, paths
from padgs.data.synthetic.options import SCENES, SyntheticOptions
from padgs.data.synthetic.textures import Array
from padgs.data.synthetic.truth import SyntheticTruth
from padgs.files import draft_of
from padgs.scene import Scene, View

__all__ = ["SCENES", "SyntheticOptions", "SyntheticTruth", "generate", "load"]


OF_CAPTURES = {  # key of `data` -> what does the same in a generated scene
    "images": "",
    "points": ", and set data.generator.points",
    "mask": "",
    "depth": "",
    "split": ", and set data.generator.train_views and test_views",
    "test_every": ", and set data.generator.test_views",
}


def load(path: str | Path, options: DataOptions) -> Scene:
    """Load the synthetic scene `path`, or the one in `options.generator` if it is empty; the entry of LOADERS.

    A DataError names settings of captures, which would change nothing.
    """
    for name, instead in OF_CAPTURES.items():
        if (value := getattr(options, name)) != getattr(DataOptions(), name):
            raise DataError(f"data.{name}={value} changes nothing in a generated scene; leave it out{instead}")
    settings = dict(options.generator)
    if str(path) not in ("", "."):
        settings["scene"] = str(path)
    if options.width is not None:
        settings["width"] = options.width
    try:
        scene = typed(SyntheticOptions, settings, "data.generator")
    except ConfigError as error:
        raise DataError(str(error)) from error
    return generate(scene, ImageStore(options.cache_bytes, options.prefetch_threads, options.device))


def generate(options: SyntheticOptions, store: ImageStore | None = None) -> Scene:
    """Generate a scene, or read it from the disk cache; 30 views at 512x256 take 15-20 s of CPU time."""
    stored, problem = read_cache(options), None
    if stored is None:
        stored = _make(options)
        problem = write_cache(options, stored)
        stored = read_cache(options) or stored
    store, held_out = store or ImageStore(), set(paths.held_out(options))
    size, train, test = (options.width, options.height), [], []
    for index, (image, pose) in enumerate(zip(stored.images, stored.poses, strict=True)):
        pixels = StoredImage(image, *size, store) if isinstance(image, Path) else partial(torch.from_numpy, image)
        depth = partial(_depth, options, index)
        view = View(f"{index:03d}", torch.from_numpy(pose), *size, pixels, load_depth=depth)
        (test if index in held_out else train).append(view)
    points, colors = torch.from_numpy(stored.points).float(), torch.from_numpy(stored.colors)
    notes = (problem,) if problem else ()
    return Scene(options.title, tuple(train), tuple(test), points, colors, stored.fingerprint, notes)


@lru_cache(maxsize=64)
def _depth(options: SyntheticOptions, index: int) -> torch.Tensor:
    """Return the true distances [H, W] from the exact camera centre of a view."""
    truth = _truth(options)
    name = truth.names[index]
    return truth.depth(View(name, truth.exact_pose(name), options.width, options.height)).float()


@lru_cache(maxsize=1)
def _truth(options: SyntheticOptions) -> SyntheticTruth:
    return SyntheticTruth(options)


def _make(options: SyntheticOptions) -> Stored:
    truth = SyntheticTruth(options)
    held_out = set(paths.held_out(options))
    images = []
    for index, pose in enumerate(truth.poses):
        world = truth.world_seen(index)
        if index in held_out or not (options.lens_gap or options.lens_k1):
            images.append(camera.draw(world, pose, options.width, options.samples, options.seed))
        else:
            images.append(camera.draw_stitched(world, pose, options.lens_gap * truth.median_depth, options))
    train = [index for index in range(len(images)) if index not in held_out]
    seen = [images[index] for index in train]
    points, colors = camera.sample_points(truth.world, truth.poses[train], seen, options, truth.random("points"))
    points, poses = options.world_scale * points, truth.given_poses
    digest = hashlib.sha256(repr(sorted(held_out)).encode())
    for array in (*images, poses, points, colors):
        digest.update(np.ascontiguousarray(array).tobytes())
    return Stored(images, poses, points, colors, digest.hexdigest())


@dataclass(frozen=True)
class Stored:
    """Generated data of a Scene, in world units."""

    images: list[Array] | list[Path]  # of all views along the path: [H, W, 3] uint8, or PNG files
    poses: Array  # [n, 4, 4] cam_from_world with pose noise
    points: Array  # [P, 3]
    colors: Array  # [P, 3] uint8
    fingerprint: str


def cache_folder(options: SyntheticOptions) -> Path:
    """Return the cache folder of a scene, named by a hash of its options and of the code that generates scenes.

    It is in $PADGS_CACHE, or ~/.cache/padgs, and holds PNGs, `scene.npz` and the digest of both. A scene that does not
    fit its digest is generated again. Without write access there is no cache.
    """
    digest = hashlib.sha256(json.dumps(asdict(options), sort_keys=True).encode())
    digest.update(b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.iterdir()) if path.is_file()))
    return cache_root() / "synthetic" / digest.hexdigest()[:24]


def _digest(entry: Path) -> str:
    digest = hashlib.sha256()
    for file in sorted(entry.glob("*.*")):
        digest.update(f"{file.name}|".encode() + file.read_bytes())
    return digest.hexdigest()


def read_cache(options: SyntheticOptions) -> Stored | None:
    """Read a cached scene; None if it is missing or was changed."""
    entry = cache_folder(options)
    try:
        if (entry / "sha256").read_text() != _digest(entry):
            return None
        with np.load(entry / "scene.npz", allow_pickle=False) as table:
            images, fingerprint = sorted(entry.glob("*.png")), str(table["fingerprint"])
            return Stored(images, table["poses"], table["points"], table["colors"], fingerprint)
    except (OSError, ValueError):
        return None


def write_cache(options: SyntheticOptions, stored: Stored) -> str | None:
    """Cache a scene; returns the reason if that is impossible."""
    entry = cache_folder(options)
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
            if entry.exists() and read_cache(options) is None:
                shutil.rmtree(entry)  # changed or damaged
            draft.rename(entry)
    except OSError as error:
        if read_cache(options) is not None:
            return None  # another process was faster
        return f"generated scene not cached: {error}; set PADGS_CACHE to a folder that can be written"
    return None
