"""Checks of a data set: everything that is wrong with it, reported at once; and an image of its points."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

import padgs.data
from padgs.data import conventions
from padgs.data.assemble import assemble
from padgs.data.camera_paths import Gravity, centers, gravity, path_length
from padgs.data.capture import Capture, DataError, DataOptions, Frame, Progress, listed, natural_key, view_name
from padgs.data.cloud import GREY
from padgs.data.images import decode, inspect, refuse_dual_fisheye
from padgs.data.masks import MAX_HIDDEN
from padgs.geometry.panorama import project
from padgs.scene import Scene, View, move_origin

OVERLAY = "check.png"  # default name, beside the data
MAX_WIDTH = 2048  # of the overlay
MAX_REPROJECTION = 1 / 500  # of the width, for the median error: 4 pixels of 2048
MIN_POINTS = 30  # whose colours are compared
DEPTH_TOLERANCE, DEPTH_AGREES = 0.1, 0.2  # of a distance; least share of the points, of which walls hide many
LEAK_DISTANCE = 0.01  # of the median depth: a test view nearer to a training view tests memory
UNEVEN_EXPOSURE = 0.1  # standard deviation of the gains in doublings, from which learning exposures helps
EXPOSURE_VIEWS = 40  # maximum number of views for measuring exposures


@dataclass
class Report:
    """Result of `padgs check`. Lengths are in world units; pixels are those of the model's cameras."""

    path: Path
    format: str = ""
    train: int = 0
    test: int = 0
    unused: int = 0
    points: int = 0
    coloured: bool = False
    resolution: str = ""
    gravity: Gravity | None = None
    path_length: float = 0.0
    median_depth: float = 0.0
    observations: int = 0
    reprojection_median: float | None = None  # pixels
    reprojection_95: float | None = None  # pixels
    colour_correlation: float | None = None  # between points and images, with the poses as stated
    exposure_spread: float | None = None  # doublings, standard deviation of the gains of the training views
    masked: dict[str, float] = field(default_factory=dict)  # view -> masked share of its pixels (by weight)
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    suggestion: str | None = None  # pose convention under which the points fit
    overlay: Path | None = None


def check(
    path: Path,
    *,
    format: str = "auto",
    options: DataOptions = DataOptions(),  # noqa: B008 - frozen dataclass
    overlay: Path | None = None,
    progress: Progress = lambda done, total: None,
) -> Report:
    """Check a data set. Problems are collected in `Report.problems`; they raise nothing.

    `path`, `format` and `options` are as for `padgs.data.load`; `overlay` is the file for the image of points on a
    panorama, None for none; `progress` is called with (images decoded, images in all).
    """
    report = Report(Path(path))
    try:
        capture = padgs.data.read(path, format, options)
    except DataError as error:
        report.problems.append(str(error))
        return report
    report.format = capture.format
    used = [frame for frame in capture.frames if frame.lens is None or options.cameras != "panoramas"]
    digests = _check_images(used, report, progress)
    damaged = bool(report.problems)
    scene, points = _assemble(capture, options, report)
    if scene is None:
        return report
    measured = None if points == "random" else capture.cloud  # else training starts from random points
    views = (*scene.train, *scene.test)
    poses = torch.stack([view.cam_from_world for view in views])
    report.train, report.test = len(scene.train), len(scene.test)
    report.unused = len(used) - report.train - report.test
    report.points, report.coloured = len(scene.points), bool((scene.point_colors != GREY).any())
    sizes = sorted({(view.width, view.height) for view in views})
    report.resolution = listed(f"{width}x{height}" for width, height in sizes)
    report.notes += scene.notes
    report.gravity = gravity(poses)
    ordered = sorted(used, key=lambda frame: natural_key(frame.name))
    report.path_length = path_length(torch.stack([frame.cam_from_world for frame in ordered]))
    report.median_depth = scene.scale
    report.masked = {view.name: 1 - mask.mean().item() for view in views if (mask := view.mask()) is not None}
    shares = [(view.name, getattr(view.load_mask, "hidden", 0.0)) for view in views]
    if hidden := [f"{name} ({share:.1%})" for name, share in shares if share > MAX_HIDDEN]:
        text = f"the masks of {len(hidden)} views hide more than {MAX_HIDDEN:.0%} of the sphere: {listed(hidden)}; "
        text += "255 means use, 0 means ignore: repair them, or set data.mask to none, inverted or a folder"
        (report.problems if options.mask == capture.mask == "auto" else report.notes).append(text)
    _check_leaks(scene, digests, report)
    if len(views) > 1 and replace(scene, train=views).has_single_center:
        report.problems.append("all cameras have the same centre; depth cannot be learned")
    if damaged:  # the fit needs readable pixels
        return report
    scene = replace(scene, train=scene.panoramas, test=tuple(view for view in scene.test if view.lens is None))
    _check_fit(capture, scene, report, is_measured=measured is not None)
    if measured is not None:
        _check_depth(scene, report)
    if overlay is not None:
        try:
            draw_overlay((scene.test or scene.train)[0], scene.points, overlay)
            report.overlay = overlay
        except DataError as error:
            report.problems.append(str(error))
    return report


def _check_depth(scene: Scene, report: Report) -> None:
    """Compare measured depth maps with the points: those that a view sees lie at its depth, others behind it."""
    ratios, points = [], scene.points[:: -(-len(scene.points) // 20_000)].double()
    for view in (*scene.train, *scene.test):
        if view.load_depth is not None and not view.depth_is_relative and view.lens is None and len(ratios) < 8:
            seen = points @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
            columns, rows = project(seen, view.width, view.height).floor().long().unbind(-1)
            depth = view.load_depth().double()[rows.clamp(0, view.height - 1), columns % view.width]
            ratios.append((depth / seen.norm(dim=-1))[torch.isfinite(depth) & (depth > 0)])
    if not ratios or not len(ratio := torch.cat(ratios)):
        return
    agree, scale = ((ratio - 1).abs() < DEPTH_TOLERANCE).double().mean().item(), ratio.quantile(0.8).item()
    text = f"depth maps agree with {agree:.0%} of the points to {DEPTH_TOLERANCE:.0%}"
    if agree >= DEPTH_AGREES:
        report.notes.append(text)
        return
    remedy = "correct the unit or measure in depth.json, or set data.depth=none"
    report.problems.append(f"{text}, and are about {scale:.2g} times as far; {remedy}")


def _check_images(frames: Sequence[Frame], report: Report, progress: Progress) -> dict[str, str]:
    """Decode all images, so that damaged files are found before training; return the digests of files by view."""
    digests = {}
    for done, frame in enumerate(frames):
        if frame.image.is_file():  # missing ones are reported together
            try:
                digests[view_name(frame.name)] = inspect(frame.image, panorama=frame.lens is None).digest
                pixels = decode(frame.image)
                if frame.lens is None:
                    refuse_dual_fisheye(pixels, frame.image)
            except DataError as error:
                report.problems.append(str(error))
        progress(done + 1, len(frames))
    return digests


def _assemble(capture: Capture, options: DataOptions, report: Report) -> tuple[Scene | None, str]:
    """Build the scene, if need be without mask, split, points or depth, to report all problems; return `points` too."""
    mask, split, points, depth = {"mask": "none"}, {"split": "all"}, {"points": "random"}, {"depth": "none"}
    for change in ({}, mask, split, points, depth, mask | split, mask | split | points | depth):
        try:
            tried = replace(options, **change)
            return assemble(capture, tried), tried.points
        except DataError as error:
            if str(error) not in report.problems:
                report.problems.append(str(error))
    return None, options.points


def _check_leaks(scene: Scene, digests: dict[str, str], report: Report) -> None:
    """Find views that are identical, and test views that are close to training views."""
    seen: dict[str, str] = {}
    for view in (*scene.train, *scene.test):
        if (twin := seen.setdefault(digests[view.name], view.name)) != view.name:
            report.problems.append(f"{view.name} is the same image as {twin}; remove one of them")
    if not scene.test:
        return
    train, test = (centers(torch.stack([view.cam_from_world for view in views])) for views in (scene.train, scene.test))
    near = torch.cdist(test, train).min(1).values < LEAK_DISTANCE * report.median_depth
    if near.any():
        names = [view.name for view, is_near in zip(scene.test, near.tolist(), strict=True) if is_near]
        report.notes.append(
            f"{len(names)} test views are within {LEAK_DISTANCE:.0%} of the median depth of a training view "
            f"({listed(names)}); they test memory more than synthesis"
        )


def _check_fit(capture: Capture, scene: Scene, report: Report, *, is_measured: bool) -> None:
    """Compare points with observations, else with colours, under the stated and other pose conventions."""
    known = conventions.known_conventions()
    tracks = None if capture.tracks is None or capture.cloud is None else capture.tracks()
    if tracks is not None:  # those of photographs are not compared
        tracks = tracks.at(torch.tensor([frame.lens is None for frame in capture.frames])[tracks.frame])
    sizes = {(frame.width, frame.height) for frame in capture.frames if frame.lens is None}
    width, height = next(iter(sizes))
    if tracks is not None and len(tracks.frame) and len(sizes) == 1 and width is not None and height is not None:
        assert capture.cloud is not None
        poses, points = torch.stack([frame.cam_from_world for frame in capture.frames]), capture.cloud.points
        error = conventions.reprojection_errors(poses, points, tracks, width, height)
        report.observations = len(error)
        report.reprojection_median = error.median().item()
        report.reprojection_95 = error.sort().values[int(0.95 * (len(error) - 1))].item()
        limit = MAX_REPROJECTION * width
        if report.reprojection_median > limit:
            rule = f"it must be at most {limit:.1f} at this size"
            report.problems.append(f"the median reprojection error is {report.reprojection_median:.1f} pixels; {rule}")
            some = tracks.at(slice(None, None, max(1, len(tracks.frame) // conventions.POINTS)))
            tried = (one.convert(poses.double()) for one in known)
            found = [conventions.reprojection_errors(pose, points, some, width, height) for pose in tried]
            errors = [error.median().item() for error in found]
            if min(errors) <= limit:
                report.suggestion = known[errors.index(min(errors))].words
    rows: dict[str, Tensor] = {}  # of the points that each view observes
    if tracks is not None and capture.cloud is not None and len(capture.cloud.points) == len(scene.points):
        names = [view_name(frame.name) for frame in capture.frames]
        rows = {name: tracks.point[tracks.frame == number] for number, name in enumerate(names)}
    # A few points, or points of one colour, correlate with anything or nothing.
    compared = report.coloured and report.points >= MIN_POINTS and scene.point_colors.float().std(0).max() >= 1
    if not (compared or report.observations):
        report.notes.append("poses are not compared with images: there are neither observations nor coloured points")
    if not is_measured:
        return
    if report.suggestion is None:
        _check_exposures(scene, rows, report)
    if not compared:
        return
    views = (*scene.train, *scene.test)
    views = views[:: max(1, len(views) // conventions.VIEWS)][: conventions.VIEWS]
    # In the world of the data set.
    poses = move_origin(torch.stack([view.cam_from_world for view in views]), -scene.origin).double()
    images, (chosen, observed) = _small(views), _observed(scene, rows, views)
    points, colors = scene.points[chosen].double() + scene.origin, scene.point_colors[chosen]
    fits = [conventions.colour_fit(one.convert(poses), images, points, colors, observed) for one in known]
    stated, best, least = fits[0], max(fits), conventions.MIN_CORRELATION
    report.colour_correlation = stated
    if best > max(least, stated + conventions.MIN_GAIN) and report.suggestion is None:
        report.problems.append(
            f"points and panoramas do not agree: their colours correlate by {stated:.2f} with the poses as "
            f"stated, and by {best:.2f} under another convention"
        )
        report.suggestion = known[fits.index(best)].words
    elif stated < least and report.suggestion is None:
        report.problems.append(
            f"the colours of points and panoramas correlate by only {stated:.2f} (at least {least} if they agree), and "
            "under no other known convention better; look at the overlay. Are these the images, points and poses of "
            "one reconstruction, with the names in the right order?"
        )


def _observed(scene: Scene, rows: dict[str, Tensor], views: Sequence[View]) -> tuple[Tensor, Tensor | None]:
    """Return the points to compare with views, and whether each view observes each, [F, P] bool; None: not known.

    Walls between rooms hide most points, so those that most views observe are chosen, if views observe enough.
    """
    observed = torch.zeros(len(views), len(scene.points), dtype=torch.bool)
    for row, view in zip(observed, views, strict=True):
        row[rows.get(view.name, [])] = True
    most = observed.sum(0).argsort(descending=True, stable=True)[: conventions.POINTS]
    if observed[:, most].sum(1).median() < MIN_POINTS:
        return torch.arange(len(scene.points)), None
    return most, observed[:, most]


def _check_exposures(scene: Scene, rows: dict[str, Tensor], report: Report) -> None:
    views = scene.train[:: -(-len(scene.train) // EXPOSURE_VIEWS)]
    if len(views) < 2:
        return
    poses = torch.stack([view.cam_from_world for view in views])
    chosen, observed = _observed(scene, rows, views)
    gains = conventions.exposure_gains(poses, _small(views), scene.points[chosen], observed)
    report.exposure_spread = gains.std().item()
    if report.exposure_spread >= UNEVEN_EXPOSURE:
        dark, bright = (views[int(index)].name for index in (gains.argmin(), gains.argmax()))
        report.notes.append(
            f"exposures differ: pixel values are {2 ** gains.min():.2f} ({dark}) to {2 ** gains.max():.2f} times "
            f"those of the median view ({bright}); train with train.exposures=learned, or capture with a fixed exposure"
        )


def _small(views: Sequence[View]) -> Tensor:
    return conventions.small_images(view.load_pixels().cpu().numpy() for view in views if view.load_pixels)


def draw_overlay(view: View, points: Tensor, path: Path, most: int = 20_000) -> None:
    """Save a panorama with at most `most` points [P, 3] drawn on it as PNG, red = near, blue = far (by rank)."""
    assert view.load_pixels is not None
    image = Image.fromarray(view.load_pixels().cpu().numpy())
    if image.width > MAX_WIDTH:
        image = image.resize((MAX_WIDTH, MAX_WIDTH // 2), Image.Resampling.BOX)
    pixels = np.asarray(image).astype(np.float32) * 0.6
    height, width = pixels.shape[:2]
    points = points[:: -(-len(points) // most)].double()
    seen = points @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    column, row = project(seen, width, height).long().unbind(1)
    rank = seen.norm(dim=1).argsort(descending=True)  # far points first, near ones on top
    nearness = torch.linspace(0, 1, len(rank)).numpy()[:, None]
    color = 255 * (nearness * np.array([1.0, 0.25, 0.0]) + (1 - nearness) * np.array([0.0, 0.5, 1.0]))
    radius = max(0, width // 1024)
    for down in range(-radius, radius + 1):
        for right in range(-radius, radius + 1):
            r, c = (row[rank] + down).clamp(0, height - 1).numpy(), ((column[rank] + right) % width).numpy()
            pixels[r, c] = color
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(path)
    except OSError as error:
        raise DataError(f"cannot write the image {path} ({error.strerror or error}); choose another path") from error
