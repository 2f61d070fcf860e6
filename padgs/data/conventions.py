"""Conventions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import torch
from torch import Tensor

from padgs.data.camera_paths import centers
from padgs.data.capture import Tracks
from padgs.geometry.panorama import project

POINTS = 3000  # a sample is enough to tell conventions apart
VIEWS = 8


@dataclass(frozen=True)
class Convention:
    """Another way to read the poses: what to do about it, and the poses it gives."""

    words: str
    convert: Callable[[Tensor], Tensor]  # cam_from_world [F, 4, 4] -> the same


@dataclass(frozen=True)
class Fit:
    """How well the points fit under a convention."""

    convention: Convention
    score: float  # correlation of colours, or minus the median error in pixels


def colour_fit(
    poses: Tensor, images: Tensor, points: Tensor, colors: Tensor, conventions: Sequence[Convention]
) -> list[Fit]:
    """Correlation of point and pixel colours under each convention; 1 = the same, about 0 = unrelated.

    Args:
        poses: [F, 4, 4] cam_from_world.
        images: [F, H, W, 3] uint8, panoramas reduced to a few hundred pixels width.
        points: [P, 3] world.
        colors: [P, 3] uint8.
        conventions: to be tried.
    """
    step = max(1, len(points) // POINTS)
    points, colors = points[::step].double(), colors[::step].float()
    height, width = images.shape[1:3]
    frame = torch.arange(len(images))[:, None]
    fits = []
    for convention in conventions:
        pose = convention.convert(poses.double())
        seen = (points @ pose[:, :3, :3].mT + pose[:, None, :3, 3]).float()
        column, row = project(seen, width, height).long().unbind(-1)
        found = images[frame, row.clamp(0, height - 1), column % width].float()
        fits.append(Fit(convention, _correlation(found, colors.expand_as(found)).mean().item()))
    return fits


def track_fit(
    poses: Tensor, points: Tensor, tracks: Tracks, width: int, height: int, conventions: Sequence[Convention]
) -> list[Fit]:
    """Minus the median reprojection error of the observations under each convention, in pixels of width x height."""
    step = max(1, len(tracks.frame) // POINTS)
    frame, point, pixels = tracks.frame[::step], tracks.point[::step], tracks.pixels[::step]
    some = points[point].double()
    fits = []
    for convention in conventions:
        pose = convention.convert(poses.double())[frame]
        error = reprojection_error((pose[:, :3, :3] @ some[..., None])[..., 0] + pose[:, :3, 3], pixels, width, height)
        fits.append(Fit(convention, -error.median().item()))
    return fits


def reprojection_error(points: Tensor, pixels: Tensor, width: int, height: int) -> Tensor:
    """Distance in pixels [T] between where camera-frame points [T, 3] fall and where they were seen [T, 2].

    Taken on the image, so that it says what structure from motion says, but the short way round across the seam, and
    along a row by the cosine of the latitude, so that it means the same angle everywhere.
    """
    difference = project(points, width, height) - pixels
    along = (difference[:, 0] + width / 2) % width - width / 2
    along = along * torch.cos((pixels[:, 1] / height - 0.5) * torch.pi)
    return torch.hypot(along, difference[:, 1])


def known_conventions() -> list[Convention]:
    """As stated first, then every reading that files of other programs have been seen to need."""
    readings: dict[str, Callable[[Tensor], Tensor]] = {
        "": lambda poses: poses,
        "the poses are world from camera: invert them": torch.linalg.inv,
        "the rotations are transposed: transpose them and keep the centres": _transposed,
        "what stands for the translation is the centre: use t = -R t": _from_center,
        "what stands for the centre is the translation: use C = -R^T C": _to_center,
    }
    same, *others = _signed_axes()
    found = []
    for (reading, convert), (words, axes) in product(readings.items(), (same, *others)):
        text = "; ".join(filter(None, (reading, words and f"camera axes: {words}")))
        whole = text or "the poses are right as they are"
        found.append(Convention(whole, lambda poses, convert=convert, axes=axes: axes @ convert(poses)))
    for words, axes in others:
        text = f"poses and points stand in different worlds: rotate the points, {words}"
        found.append(Convention(text, lambda poses, axes=axes: poses @ axes))
    return found


def _signed_axes() -> Iterator[tuple[str, Tensor]]:
    """The 48 ways to name and point three axes, in words and as [4, 4]; the first is the identity, without words."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = torch.zeros(4, 4, dtype=torch.float64)
        matrix[3, 3] = 1
        matrix[range(3), order] = torch.tensor(signs, dtype=torch.float64)
        names = [f"{'-' if sign < 0 else ''}{'xyz'[axis]}" for axis, sign in zip(order, signs, strict=True)]
        words = f"take ({', '.join(names)}) for (x, y, z)" if names != ["x", "y", "z"] else ""
        if names == ["x", "-y", "-z"]:
            words += ", as from OpenGL, Blender or nerfstudio"
        yield words + (", which mirrors" if torch.linalg.det(matrix) < 0 else ""), matrix


def _transposed(poses: Tensor) -> Tensor:
    turned = poses[:, :3, :3].mT
    return _with(poses, turned, -turned @ centers(poses)[..., None])


def _from_center(poses: Tensor) -> Tensor:
    return _with(poses, poses[:, :3, :3], -poses[:, :3, :3] @ poses[:, :3, 3:])


def _to_center(poses: Tensor) -> Tensor:
    return _with(poses, poses[:, :3, :3], centers(poses)[..., None])


def _with(poses: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    out = poses.clone()
    out[:, :3, :3], out[:, :3, 3:] = rotation, translation
    return out


def _correlation(a: Tensor, b: Tensor) -> Tensor:
    """Pearson's over P of two [F, P, 3]; [F, 3]."""
    a, b = a - a.mean(1, keepdim=True), b - b.mean(1, keepdim=True)
    return (a * b).sum(1) / (a.norm(dim=1) * b.norm(dim=1)).clamp(min=1e-6)


DARKEST, BRIGHTEST = 8, 250  # pixel values between which a gain shows
ROUNDS = 10  # of medians over points and views, after which they stand


def exposure_gains(poses: Tensor, images: Tensor, points: Tensor) -> Tensor:
    """How often each view [F] doubles the stored values of the median one, a doubling being about two stops of light
    in sRGB; 0 where too little is known.

    A pixel is a gain of its view times a brightness of its point. Both are medians of what the other leaves, so the
    points that something hides from a view, or that shine, are outvoted.

    Args:
        poses: [F, 4, 4] cam_from_world.
        images: [F, H, W, 3] uint8, panoramas reduced to a few hundred pixels width.
        points: [P, 3] world.
    """
    points = points[:: max(1, len(points) // POINTS)].double()
    height, width = images.shape[1:3]
    seen = points @ poses[:, :3, :3].double().mT + poses[:, None, :3, 3].double()
    column, row = project(seen, width, height).long().unbind(-1)
    pixels = images[torch.arange(len(images))[:, None], row.clamp(0, height - 1), column % width].float()
    usable = (pixels.mean(-1) >= DARKEST) & (pixels.amax(-1) <= BRIGHTEST)
    doublings = torch.where(usable, pixels.mean(-1).log2(), torch.nan)  # [F, P]
    gains = doublings.new_zeros(len(doublings))
    for _ in range(ROUNDS):
        of_points = (doublings - gains[:, None]).nanmedian(0).values
        gains = (doublings - of_points).nanmedian(1).values.nan_to_num()
        gains = gains - gains.median()
    return gains
