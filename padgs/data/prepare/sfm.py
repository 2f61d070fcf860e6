"""Structure from motion with pycolmap, step by step: features, matches, poses, and a final robust refinement.

Features and matches are computed in batches, which gives progress and resumes from the database. pycolmap logs to the
process's standard error and ignores its own switches; `log_to` redirects that.
"""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from padgs.data.capture import Progress
from padgs.data.formats.colmap_lens import pycolmap_module

MAPPERS = ("incremental", "global")

# Tuned on real indoor and garden panoramas. COLMAP's defaults find only a thousand features in textureless rooms at
# 2048 x 1024.
PEAK_THRESHOLD = 0.004
MAX_FEATURES = 12_000
LOSS_SCALE = 1.0  # pixels, of the Cauchy loss in the final refinement
MAX_ERROR = 4.0  # pixels; points with larger reprojection errors are dropped, as in the mapper
MIN_ANGLE = 1.5  # degrees between the rays to a point
_PAIRS_PER_BATCH = 64  # of images


@dataclass(frozen=True)
class Group:
    """Images that share a camera."""

    names: tuple[str, ...]  # relative to the image folder
    width: int
    height: int
    focal: float | None = None  # pixels, of a pinhole camera with a central principal point; None = equirectangular


def extract_features(
    database: Path, folder: Path, groups: Sequence[Group], masks: Path | None, threads: int, progress: Progress
) -> None:
    """Extract features of images that are not in the database; `masks` has <image name>.png for each, 0 = ignore."""
    pycolmap = pycolmap_module()
    cameras = _register(database, groups)
    extraction = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=threads)
    extraction.sift.peak_threshold, extraction.sift.max_num_features = PEAK_THRESHOLD, MAX_FEATURES
    single = {"camera_mode": pycolmap.CameraMode.SINGLE, "extraction_options": extraction}
    total, done = sum(len(group.names) for group in groups), 0
    for group, camera_id in zip(groups, cameras, strict=True):
        reader = pycolmap.ImageReaderOptions(existing_camera_id=camera_id)
        if masks is not None:
            reader.mask_path = masks
        for batch in _batches(group.names, 2 * threads):
            pycolmap.extract_features(database, folder, image_names=list(batch), reader_options=reader, **single)
            done += len(batch)
            progress(done, total)


def _register(database: Path, groups: Sequence[Group]) -> list[int]:
    """Add missing cameras and images in a fixed order, on which results depend; return the camera of each group."""
    pycolmap = pycolmap_module()
    cameras = []
    with pycolmap.Database.open(database) as entries:
        known = {image.name: image for image in entries.read_all_images()}
        for group in groups:
            if group.names[0] in known:
                camera_id = known[group.names[0]].camera_id
                rig_id = entries.read_rig_with_sensor(entries.read_camera(camera_id).sensor_id).rig_id
            else:
                model, params = "EQUIRECTANGULAR", [group.width, group.height]
                if group.focal is not None:
                    model, params = "SIMPLE_PINHOLE", [group.focal, group.width / 2, group.height / 2]
                camera = pycolmap.Camera(model=model, width=group.width, height=group.height, params=params)
                camera.has_prior_focal_length = True
                camera_id = entries.write_camera(camera)
                rig = pycolmap.Rig()
                rig.add_ref_sensor(entries.read_camera(camera_id).sensor_id)
                rig_id = entries.write_rig(rig)
            for name in group.names:
                if name not in known:
                    image_id = entries.write_image(pycolmap.Image(name=name, camera_id=camera_id))
                    frame = pycolmap.Frame()
                    frame.rig_id = rig_id
                    frame.add_data_id(entries.read_image(image_id).data_id)
                    entries.write_frame(frame)
            cameras.append(camera_id)
    return cameras


def match(
    database: Path, pairs: Sequence[Sequence[tuple[str, str]]], rig: bool, threads: int, seed: int, progress: Progress
) -> None:
    """Match and verify groups of unmatched pairs of images; a rig's group, all views of two panoramas, jointly."""
    pycolmap = pycolmap_module()
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=threads)
    matching.rig_verification = matching.skip_image_pairs_in_same_frame = rig
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    options = {"matching_options": matching, "verification_options": verification}
    file, done = database.with_name("pairs.txt"), 0
    for batch in _batches(pairs, max(1, _PAIRS_PER_BATCH // len(pairs[0]))):
        file.write_text("".join(f"{a} {b}\n" for group in batch for a, b in group), encoding="utf-8")
        pairing = pycolmap.ImportedPairingOptions(match_list_path=file)
        pycolmap.match_image_pairs(database, pairing_options=pairing, **options)
        done += len(batch)
        progress(done, len(pairs))
    file.unlink(missing_ok=True)


def reconstruct(
    database: Path, folder: Path, parts: Path, threads: int, seed: int, views: int, progress: Progress, mapper: str
) -> int:
    """Compute poses and points; write a model for each part that cannot be connected to others, return their number.

    `views` is the number of views in a rig, else 1. `mapper` is one of `MAPPERS`: incremental adds one panorama after
    the other, global places all at once.
    """
    pycolmap = pycolmap_module()
    pycolmap.set_random_seed(seed)
    with pycolmap.Database.open(database) as found:
        total = found.num_images() // views
    if mapper == "global":
        options = pycolmap.GlobalPipelineOptions(num_threads=threads, random_seed=seed, min_model_size=2)
        adjustment = options.mapper.bundle_adjustment
        adjustment.refine_focal_length = adjustment.refine_principal_point = adjustment.refine_extra_params = False
        options.mapper.refine_sensor_from_rig = adjustment.refine_sensor_from_rig = False
        return len(pycolmap.global_mapping(database, folder, parts, options))
    options = pycolmap.IncrementalPipelineOptions(num_threads=threads, random_seed=seed, min_model_size=2)
    # For a panoramic camera, forward motion is as good as any other direction.
    options.mapper.init_max_forward_motion = 1.0
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    options.ba_refine_sensor_from_rig = False
    placed = 0

    def tell(number: int) -> None:
        nonlocal placed
        placed = number
        progress(min(placed, total), total)

    callbacks = {"initial_image_pair_callback": lambda: tell(2), "next_image_callback": lambda: tell(placed + 1)}
    return len(pycolmap.incremental_mapping(database, folder, parts, options, **callbacks))


def refine(model: Any, threads: int) -> None:
    """Run a robust bundle adjustment, and drop points with large errors.

    A Cauchy loss reduces the weight of wrong matches; this halves the largest rotation errors of real panoramas.
    """
    pycolmap = pycolmap_module()
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.refine_sensor_from_rig = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_SCALE
    options.ceres.solver_options.function_tolerance = 1e-10
    options.ceres.solver_options.num_threads = threads
    pycolmap.bundle_adjustment(model, options)
    pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR, MIN_ANGLE)
    model.update_point_3d_errors()


@contextmanager
def log_to(path: Path) -> Iterator[None]:
    """Append standard error of the whole process (Python's and pycolmap's) to a file while the context lasts."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(path, "ab") as file:
            os.dup2(file.fileno(), 2)
        yield
    finally:
        sys.stderr.flush()
        os.dup2(kept, 2)
        os.close(kept)


def _batches(items: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    for start in range(0, len(items), size):
        yield items[start : start + size]
