"""Synthetic scenes with exact ground truth: an analytic world, ray-cast into panoramas.

`generate(SyntheticOptions()) -> Scene` renders (or reads from the cache) panoramas, poses and a noisy point cloud;
`SyntheticTruth` gives exact depth, object ids and poses, and renders new views. World frame: z up, x and y horizontal,
one unit per metre unless `world_scale` changes that.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch

from padgs.checks import ConfigError, typed
from padgs.data.capture import DataError, DataOptions
from padgs.data.store import ImageStore, StoredImage
from padgs.data.synthetic import cache, camera, paths
from padgs.data.synthetic.camera import draw_stitched, sample_points
from padgs.data.synthetic.options import SCENES, SyntheticOptions
from padgs.data.synthetic.truth import SyntheticTruth
from padgs.scene import Scene, View

__all__ = ["SCENES", "SyntheticOptions", "SyntheticTruth", "generate", "load"]


def load(path: str | Path, options: DataOptions) -> Scene:
    """Load the synthetic scene `path`, or the one in `options.generator` if it is empty; the entry of LOADERS.

    Raises:
        DataError: unknown scene or field, or an invalid value.
    """
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
    """Generate a scene, or read it from the disk cache.

    Takes 15-20 s of processor time for 30 views at 512 x 256, on all processors. `store` caches decoded images.
    """
    stored, notes = cache.read(options), []
    if stored is None:
        stored = _make(options)
        problem = cache.write(options, stored)
        notes = [problem] if problem else []
        stored = cache.read(options) or stored
    store = store or ImageStore()
    held_out = set(paths.held_out(options))
    train, test = [], []
    for index, (image, pose) in enumerate(zip(stored.images, stored.poses, strict=True)):
        if isinstance(image, Path):
            pixels = StoredImage(image, options.width, options.height, store)
        else:
            pixels = partial(torch.from_numpy, image)
        size, depth = (options.width, options.height), partial(_depth, options, index)
        view = View(f"{index:03d}", torch.from_numpy(pose), *size, pixels, load_depth=depth)
        (test if index in held_out else train).append(view)
    return Scene(
        name=options.title,
        train=tuple(train),
        test=tuple(test),
        points=torch.from_numpy(stored.points).float(),
        point_colors=torch.from_numpy(stored.colors),
        fingerprint=stored.fingerprint,
        notes=tuple(notes),
    )


@lru_cache(maxsize=64)
def _depth(options: SyntheticOptions, index: int) -> torch.Tensor:
    """Return the true distances [H, W] from the exact camera centre of a view."""
    truth = _truth(options)
    name = truth.names[index]
    return truth.depth(View(name, truth.exact_pose(name), options.width, options.height)).float()


@lru_cache(maxsize=1)
def _truth(options: SyntheticOptions) -> SyntheticTruth:
    return SyntheticTruth(options)


def _make(options: SyntheticOptions) -> cache.Stored:
    truth = SyntheticTruth(options)
    held_out = set(paths.held_out(options))
    images = []
    for index, pose in enumerate(truth.poses):
        if index in held_out or not (options.lens_gap or options.lens_k1):
            images.append(camera.draw(truth.world, pose, options.width, options.samples, options.seed))
        else:
            gap = options.lens_gap * truth.median_depth
            images.append(draw_stitched(truth.world, pose, gap, options))
    train = [index for index in range(len(images)) if index not in held_out]
    points, colors = sample_points(
        truth.world, truth.poses[train], [images[index] for index in train], options, truth.random("points")
    )
    points, poses = options.world_scale * points, truth.given_poses
    digest = hashlib.sha256(repr(sorted(held_out)).encode())
    for array in (*images, poses, points, colors):
        digest.update(np.ascontiguousarray(array).tobytes())
    return cache.Stored(images, poses, points, colors, digest.hexdigest())
