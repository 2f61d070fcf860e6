"""Agreement of points and panoramas: pose conventions and exposures.

A wrong axis convention trains without an error, but badly. Observations of structure from motion reveal it exactly, by
their reprojection error. Otherwise the colours of points are compared with the pixels they project to: they correlate
strongly only if axes, handedness and direction of the poses are right, even if some points are hidden.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from padgs.data.camera_paths import centers
from padgs.data.capture import Capture, DataError, Reading, Tracks
from padgs.data.images import decode
from padgs.data.store import area_resize
from padgs.geometry.panorama import project

POINTS = 3000  # sampled for a comparison
VIEWS = 8
SMALL = 256  # width at which colours are compared
MIN_GAIN = 0.1  # in correlation, from which another pose convention is suggested
MIN_CORRELATION = 0.3  # of the colours of points and images that agree
DARKEST, BRIGHTEST = 8, 250  # pixel values that are not clipped
ROUNDS = 10  # of alternating medians, until convergence


class Convention(NamedTuple):
    """A pose convention: how to correct poses that were stated in it."""

    words: str  # instruction for users
    convert: Callable[[Tensor], Tensor]  # stated poses [F, 4, 4] -> cam_from_world [F, 4, 4]


def colour_fit(poses: Tensor, images: Tensor, points: Tensor, colors: Tensor, observed: Tensor | None = None) -> float:
    """Return the correlation of the colours of points [P, 3] and their pixels; 1 = equal, about 0 = unrelated.

    `poses` are cam_from_world [F, 4, 4], `images` [F, H, W, 3] and `colors` [P, 3] uint8; few hundred pixels do. Black
    pixels, of which a part of a panorama consists elsewhere, do not count, nor points that are not `observed` [F, P].
    """
    found = _pixels(poses, images, points)
    colors = colors[:: max(1, len(points) // POINTS)].float().expand_as(found)
    seen = (found.amax(-1, keepdim=True) > 0).float()
    seen = seen if observed is None else seen * observed[:, :: max(1, len(points) // POINTS), None]
    count = seen.sum(1, keepdim=True).clamp(min=1)
    a, b = ((values - (values * seen).sum(1, keepdim=True) / count) * seen for values in (found, colors))
    return ((a * b).sum(1) / (a.norm(dim=1) * b.norm(dim=1)).clamp(min=1e-6)).mean().item()


def _pixels(poses: Tensor, images: Tensor, points: Tensor) -> Tensor:
    """Return the pixels [F, P, 3] float where the images show the points, of which at most about `POINTS` are used."""
    points = points[:: max(1, len(points) // POINTS)].double()
    height, width = images.shape[1:3]
    seen = (points @ poses[:, :3, :3].double().mT + poses[:, None, :3, 3].double()).float()
    column, row = project(seen, width, height).long().unbind(-1)
    return images[torch.arange(len(images))[:, None], row.clamp(0, height - 1), column % width].float()


def reprojection_errors(poses: Tensor, points: Tensor, tracks: Tracks, width: int, height: int) -> Tensor:
    """Return the reprojection errors [T] of points [P, 3] seen from poses [F, 4, 4], in pixels of width x height.

    Errors wrap around the seam; along rows they are scaled by cos(latitude), so a pixel is one angle everywhere.
    """
    pose = poses.double()[tracks.frame]
    seen = (pose[:, :3, :3] @ points[tracks.point].double()[..., None])[..., 0] + pose[:, :3, 3]
    difference = project(seen, width, height) - tracks.pixels
    along = (difference[:, 0] + width / 2) % width - width / 2
    along = along * torch.cos((tracks.pixels[:, 1] / height - 0.5) * torch.pi)
    return torch.hypot(along, difference[:, 1])


def best_reading(capture: Capture) -> Capture:
    """Choose between the readings of a capture by the colours of points and panoramas, else the first; add a note."""
    readings = [
        reading
        for i, reading in enumerate(capture.readings)
        if not any(reading.axes.equal(one.axes) and reading.world.equal(one.world) for one in capture.readings[:i])
    ]
    panoramas = [frame for frame in capture.frames if frame.lens is None]
    if not readings or not panoramas:
        return replace(capture, readings=())
    cloud, best, notes = capture.cloud, readings[0], list(capture.notes)
    if len(readings) > 1:
        some, fits, tested = panoramas[:: max(1, len(panoramas) // VIEWS)][:VIEWS], [0.0], "not tested by colours"
        poses = torch.stack([frame.cam_from_world for frame in some])
        with suppress(DataError, ValueError):  # missing and damaged images, and other shapes, are reported later
            if cloud and (colors := cloud.colors) is not None:
                images = small_images(decode(frame.image) for frame in some)
                fits = [colour_fit(one.axes @ poses, images, _moved(cloud.points, one), colors) for one in readings]
                tested = f"colours agree by {max(fits):.2f} at most, so the poses may be wrong: run padgs check"
        if max(fits) > max(MIN_CORRELATION, fits[0] + MIN_GAIN):
            best = readings[fits.index(max(fits))]
        why = f"colours agree by {max(fits):.2f}"
        if max(fits) <= MIN_CORRELATION:
            points = cloud.points if cloud else torch.zeros(0, 3)
            inside = [_share_inside(one.axes @ poses, _moved(points, one)) for one in readings]
            best, why = readings[inside.index(max(inside))], tested
        notes.append(f"{best.words}: {why}")
    frames = (replace(frame, cam_from_world=best.axes @ frame.cam_from_world) for frame in capture.frames)
    cloud = cloud and replace(cloud, points=_moved(cloud.points, best))
    return replace(capture, frames=tuple(frames), cloud=cloud, notes=tuple(notes), readings=())


def _share_inside(poses: Tensor, points: Tensor) -> float:
    """Return the share of cameras in the box around nine tenths of the points, axis by axis; 0 without points."""
    if not len(points):
        return 0.0
    low, high = (points[:: max(1, len(points) // POINTS)].double().quantile(q, 0) for q in (0.05, 0.95))
    positions = centers(poses)
    return ((positions >= low) & (positions <= high)).all(1).double().mean().item()


def _moved(points: Tensor, reading: Reading) -> Tensor:
    return points.double() @ reading.world[:3, :3].T + reading.world[:3, 3]


def small_images(panoramas: Iterable[NDArray[np.uint8]]) -> Tensor:
    """Reduce panoramas to one width of at most `SMALL`, one at a time; [F, H, W, 3] uint8."""
    reduced = [area_resize(image, width := min(SMALL, image.shape[1]), width // 2) for image in panoramas]
    width = min(image.shape[1] for image in reduced)
    return torch.stack([torch.from_numpy(area_resize(image, width, width // 2)) for image in reduced])


def known_conventions() -> list[Convention]:
    """Return the stated convention first, then all that files of other programs are known to use."""
    turned = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    corrections: dict[str, Callable[[Tensor], Tensor]] = {
        "": lambda poses: poses,
        "the poses are world from camera: invert them": torch.linalg.inv,
        # Of readers that turn y and z of the camera, which then are axes of the world.
        "the matrices are camera from world: invert them": lambda p: turned @ torch.linalg.inv(p) @ turned,
        "the rotations are transposed: transpose them and keep the centres": lambda p: _with(
            p, -p[:, :3, :3].mT @ centers(p)[..., None], p[:, :3, :3].mT
        ),
        "the translations are camera centres: use t = -R t": lambda p: _with(p, -p[:, :3, :3] @ p[:, :3, 3:]),
        "the camera centres are translations: use C = -R^T C": lambda p: _with(p, centers(p)[..., None]),
        "the quaternions are in the order x y z w: write them as w x y z": _reordered,
    }
    signed, found = [*_signed_axes()], []
    for (correction, convert), (words, axes) in product(corrections.items(), signed):
        text = "; ".join(filter(None, (correction, words and f"camera axes: {words}")))
        text = text or "the poses are right as they are"
        found.append(Convention(text, lambda poses, convert=convert, axes=axes: axes @ convert(poses)))
    for words, axes in signed[1:]:
        text = f"poses and points are in different world frames: rotate the points, {words}"
        found.append(Convention(text, lambda poses, axes=axes: poses @ axes))
    return found


def _signed_axes() -> Iterator[tuple[str, Tensor]]:
    """Yield the 48 signed axis permutations, in words and as [4, 4]; the identity first, with empty words."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = torch.zeros(4, 4, dtype=torch.float64)
        matrix[3, 3] = 1
        matrix[range(3), order] = torch.tensor(signs, dtype=torch.float64)
        names = [f"{'-' if sign < 0 else ''}{'xyz'[axis]}" for axis, sign in zip(order, signs, strict=True)]
        words = f"use ({', '.join(names)}) as (x, y, z)" if names != ["x", "y", "z"] else ""
        if names == ["x", "-y", "-z"]:
            words += ", the convention of OpenGL, Blender and nerfstudio"
        yield words + (", which mirrors" if torch.linalg.det(matrix) < 0 else ""), matrix


def _reordered(poses: Tensor) -> Tensor:
    """Return poses whose quaternion (w, x, y, z) was stated as x y z w; mirrored poses have none and are returned."""
    from scipy.spatial.transform import Rotation

    if torch.linalg.det(poses[:, :3, :3]).min() <= 0:
        return poses
    stated = Rotation.from_matrix(poses[:, :3, :3].numpy()).as_quat()[:, [3, 0, 1, 2]]
    return _with(poses, poses[:, :3, 3:], torch.from_numpy(Rotation.from_quat(stated).as_matrix()))


def _with(poses: Tensor, translation: Tensor, rotation: Tensor | None = None) -> Tensor:
    out = poses.clone()
    out[:, :3, :3], out[:, :3, 3:] = poses[:, :3, :3] if rotation is None else rotation, translation
    return out


def exposure_gains(poses: Tensor, images: Tensor, points: Tensor, observed: Tensor | None = None) -> Tensor:
    """Estimate the gain of each view [F], as log2 of pixel values relative to the median view; 0 if unknown.

    A doubling is about two stops of light in sRGB. A pixel is modelled as the gain of its view times the brightness of
    its point; both are alternating medians, robust to hidden and shiny points.

    Arguments are those of `colour_fit`.
    """
    pixels = _pixels(poses, images, points)
    usable = (pixels.mean(-1) >= DARKEST) & (pixels.amax(-1) <= BRIGHTEST)
    usable = usable if observed is None else usable & observed[:, :: max(1, len(points) // POINTS)]
    brightness = torch.where(usable, pixels.mean(-1).log2(), torch.nan)  # [F, P]
    gains = brightness.new_zeros(len(brightness))
    for _ in range(ROUNDS):
        of_points = (brightness - gains[:, None]).nanmedian(0).values
        gains = (brightness - of_points).nanmedian(1).values.nan_to_num()
        gains = gains - gains.median()
    return gains
