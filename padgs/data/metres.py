"""Worlds in metres: the scale by a known distance of two cameras, by the height of the cameras, or by GPS.

`to_metres` finds the similarity that maps a world to metres; `write_unit` states the unit beside a data set.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import ExifTags
from torch import Tensor

from padgs.data.camera_paths import centers, gravity
from padgs.data.capture import Cloud, DataError, Frame, listed, view_name
from padgs.files import folded, open_image
from padgs.geometry.similarity import Similarity

UNIT, Z = "unit.json", (0.0, 0.0, 1.0)
UPRIGHT = 0.9  # minimal length of the mean of the cameras' up directions
_FLOOR = 0.03  # half of the layer that is taken for the floor, relative to the height of the cameras
_MIN_FLOOR_POINTS, _MIN_FLOOR_SHARE = 30, 0.02  # in that layer, and of the points below the cameras
_MAX_DEEPER = 0.05  # share of the points below the cameras that may lie below the floor
_MIN_ABOVE_FLOOR = 0.7  # share of the cameras that have a point of the floor within their height, horizontally
_MAX_HEIGHTS = 0.15  # standard deviation of the cameras' heights, relative to their median
_MIN_SPREAD = 3.0  # metres, of GPS positions: their root mean square distance from their mean
_NO_GPS = "; use --metres A B DISTANCE or --camera-height"
_MAX_RESIDUAL = 0.15  # root mean square distance of cameras from their GPS positions, relative to that spread


@dataclass(frozen=True)
class KnownLength:
    """Known length in metres; at most one of these."""

    metres: tuple[str, str, float] | None = None  # two cameras, and their distance
    camera_height: float | None = None  # above the floor
    gps: bool = False  # by the EXIF of the images

    def __post_init__(self) -> None:
        if (self.metres is not None) + (self.camera_height is not None) + self.gps > 1:
            raise DataError("give one of --metres, --camera-height and --gps, as each sets the scale")
        length = self.camera_height if self.metres is None else self.metres[2]
        if length is not None and not 0 < length < math.inf:
            option = "--camera-height" if self.metres is None else "the distance of --metres"
            raise DataError(f"{option} is {length:g}; it must be a finite number of metres above 0")


def moved(frames: Sequence[Frame], cloud: Cloud | None, new_from_old: Similarity) -> tuple[tuple[Frame, ...], Any]:
    """Return frames and points, if there are any, in another world."""
    poses = (new_from_old.pose(frame.cam_from_world) for frame in frames)
    cloud = None if cloud is None else Cloud(new_from_old(cloud.points.double()), cloud.colors)
    return tuple(replace(frame, cam_from_world=pose) for frame, pose in zip(frames, poses, strict=True)), cloud


def to_metres(frames: Sequence[Frame], cloud: Cloud | None, known: KnownLength) -> tuple[Similarity, str] | None:
    """Return the similarity that leads to a world in metres, and a note on the scale; None if no length is known.

    With GPS: x east, y north, z up, from the mean position. A DataError says by which numbers there is no scale.
    """
    poses = torch.stack([frame.cam_from_world for frame in frames])
    if known.metres is not None:
        change, note = _by_distance(frames, poses, *known.metres)
    elif known.camera_height is not None:
        change, note = _by_height(poses, cloud, known.camera_height)
    elif known.gps:
        change, note = _by_gps(frames, poses)
    else:
        return None
    return change, f"lengths are in metres, {note}; before: times {change.scale:.6g}"


def write_unit(folder: Path, note: str) -> None:
    """State that the data set in a folder is in metres."""
    (folder / UNIT).write_text(json.dumps({"unit": "metre", "note": note}, indent=2) + "\n", encoding="utf-8")


def unit_note(folder: Path) -> list[str]:
    """Return the note of `write_unit` in a folder, if there is one."""
    try:
        note = json.loads((folder / UNIT).read_text(encoding="utf-8"))["note"]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    return [note] if isinstance(note, str) else []


def named(panoramas: Sequence[str], *names: str) -> list[int]:
    """Return which panoramas the names of --metres are; a DataError for one that has no pose."""
    at = {folded(name): k for k, full in enumerate(panoramas) for name in (full, view_name(full))}
    # "convert" may change the extension.
    keys = [folded(name) if folded(name) in at else folded(view_name(name)) for name in names]
    if unknown := [name for name, key in zip(names, keys, strict=True) if key not in at]:
        raise DataError(f"--metres: no panorama with a pose is called {unknown[0]!r}; known: {listed(panoramas)}")
    return [at[key] for key in keys]


def refuse_useless(known: KnownLength, images: Mapping[str, Path]) -> None:
    """Refuse a length that panoramas (name -> file) show to be useless before they have poses, by a DataError."""
    named([*images], *(known.metres or ())[:2])
    if known.gps:
        _gps_places([*images.values()])


def _by_distance(frames: Sequence[Frame], poses: Tensor, a: str, b: str, metres: float) -> tuple[Similarity, str]:
    at = named([frame.name for frame in frames], a, b)
    distance = (centers(poses)[at[0]] - centers(poses)[at[1]]).norm().item()
    extent = (centers(poses) - centers(poses).mean(0)).norm(dim=1).max().item()
    if distance <= 1e-6 * extent:
        raise DataError(f"--metres: {a} and {b} were taken at one place; name two cameras far apart")
    return Similarity(metres / distance), f"by {metres:g} m between {a} and {b}"


def _common_up(poses: Tensor, option: str) -> Tensor:
    estimate = gravity(poses)
    if estimate.agreement < UPRIGHT:
        raise DataError(
            f"{option}: the cameras have no common up direction (agreement {estimate.agreement:.2f}, and at least "
            f"{UPRIGHT:g} is needed); use --metres A B DISTANCE"
        )
    return torch.tensor(estimate.up, dtype=torch.float64)


def _by_height(poses: Tensor, cloud: Cloud | None, metres: float) -> tuple[Similarity, str]:
    """Find the floor: the fullest layer of points below the cameras, under most cameras and with little below it."""
    instead = "; use --metres A B DISTANCE"
    if cloud is None:
        raise DataError(f"--camera-height: there are no points to find the floor by{instead}")
    level = Similarity.turning(_common_up(poses, "--camera-height"), Z).rotation
    points, cameras = cloud.points.double() @ level.mT, centers(poses) @ level.mT
    points = points[points[:, 2] < cameras[:, 2].median()]
    points = points[points[:, 2].argsort(descending=True)]
    below = (cameras[:, 2].median() - points[:, 2]).numpy()
    # In the layer around a depth d: those from (1 - f) d to (1 + f) d.
    low, high = (np.searchsorted(below, below * factor) for factor in (1 - _FLOOR, 1 + _FLOOR))
    inside, deeper = high - low, len(below) - high
    fits = (inside >= max(_MIN_FLOOR_POINTS, _MIN_FLOOR_SHARE * len(below))) & (deeper <= _MAX_DEEPER * len(below))
    if not fits.any():
        raise DataError(
            f"--camera-height: no floor was found: of the {len(below)} points below the cameras, no layer with at most "
            f"{_MAX_DEEPER:.0%} below it holds {_MIN_FLOOR_POINTS} and {_MIN_FLOOR_SHARE:.0%}{instead}"
        )
    best = int(np.argmax(np.where(fits, inside, 0)))
    height = float(np.median(below[low[best] : high[best]]))
    floor = points[low[best] : high[best], :2]  # of millions of points, perhaps: one camera at a time
    near = torch.stack([(floor - camera).norm(dim=1).min() for camera in cameras[:, :2]]) < height
    if near.double().mean() < _MIN_ABOVE_FLOOR:
        raise DataError(
            f"--camera-height: no floor was found: the lowest layer, of {inside[best]} points, lies under only "
            f"{near.sum()} of {len(near)} cameras, so that it may be a table{instead}"
        )
    heights = (cameras[:, 2] - cameras[:, 2].median()).square().mean().sqrt().item() / height
    if heights > _MAX_HEIGHTS:
        raise DataError(
            f"--camera-height: the cameras' heights differ by {heights:.0%} (at most {_MAX_HEIGHTS:.0%}), so that not "
            f"all are {metres:g} m above one floor{instead}"
        )
    return Similarity(metres / height), f"by cameras {metres:g} m above the floor ({inside[best]} points)"


def _by_gps(frames: Sequence[Frame], poses: Tensor) -> tuple[Similarity, str]:
    """Fit heading, scale and place of the world, upright by the cameras, to east, north and up."""
    found, origin, truth, spread = _gps_places([frame.image for frame in frames])
    level = Similarity.turning(_common_up(poses, "--gps"), Z).rotation
    used = centers(poses)[found]
    at = used @ level.mT
    theirs, ours = (torch.complex(of[:, 0], of[:, 1]) for of in (truth, at))
    theirs, ours = theirs - theirs.mean(), ours - ours.mean()
    turn = (ours.conj() * theirs).sum() / ours.abs().square().sum()
    residual = (turn * ours - theirs).abs().square().mean().sqrt().item()
    if not residual <= _MAX_RESIDUAL * spread:
        raise DataError(
            f"--gps: cameras are {residual:.2g} m from their GPS positions (root mean square), more than "
            f"{_MAX_RESIDUAL:.0%} of the spread of {spread:.3g} m; the fit is poor{_NO_GPS}"
        )
    scale, angle = turn.abs().item(), turn.angle().item()
    c, s = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64) @ level
    change = Similarity(scale, rotation, truth.mean(0) - scale * rotation @ used.mean(0))
    axes = f"x is east, y north, z up from latitude, longitude, altitude {', '.join(f'{one:.7g}' for one in origin)}"
    return change, f"by GPS of {len(found)} images, {residual:.2g} m from the fit; {axes}"


def _gps_places(images: Sequence[Path]) -> tuple[list[int], tuple[float, float, float], Tensor, float]:
    """Return which images have a GPS position, the results of `local_metres` for these, and their horizontal spread."""
    found = {k: place for k, image in enumerate(images) if (place := gps_of(image)) is not None}
    if (different := len({place[:2] for place in found.values()})) < 3:
        have = f"{len(found)} of {len(images)} images have a GPS position, {different} different ones"
        raise DataError(f"--gps: {have}, and at least 3 are needed{_NO_GPS}")
    origin, metres = local_metres([*found.values()])
    spread = (metres[:, :2] - metres[:, :2].mean(0)).square().sum(1).mean().sqrt().item()
    if not spread >= _MIN_SPREAD:
        needed = f"and at least {_MIN_SPREAD:g} m are needed"
        raise DataError(f"--gps: the positions spread by {spread:.3g} m, {needed}{_NO_GPS}")
    return [*found], origin, metres, spread


def gps_of(image: Path) -> tuple[float, float, float] | None:
    """Return latitude and longitude in degrees, and altitude in metres (0 if unknown), by EXIF; None without GPS."""
    with open_image(image) as opened:
        tags = opened.getexif().get_ifd(ExifTags.IFD.GPSInfo)
    try:
        gps, angles = ExifTags.GPS, []
        for value, side in ((gps.GPSLatitude, gps.GPSLatitudeRef), (gps.GPSLongitude, gps.GPSLongitudeRef)):
            angle = sum(float(part) / 60**k for k, part in enumerate(tags[value]))
            angles.append(-angle if str(tags[side])[:1].upper() in {"S", "W"} else angle)
        altitude = float(tags.get(gps.GPSAltitude, 0.0))
        altitude = altitude if math.isfinite(altitude) else 0.0  # some cameras write 0/0
        if tags.get(gps.GPSAltitudeRef) in (b"\x01", 1):  # below the sea
            altitude = -altitude
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    is_place = all(map(math.isfinite, angles)) and abs(angles[0]) <= 90 and abs(angles[1]) <= 180
    return (angles[0], angles[1], altitude) if is_place and any(angles) else None


def local_metres(places: Sequence[tuple[float, float, float]]) -> tuple[tuple[float, float, float], Tensor]:
    """Return the mean place, and east, north and up [n, 3] of all in metres from it, by WGS 84."""
    import pycolmap

    degrees = np.array(places)
    degrees[:, 1] = degrees[0, 1] + (degrees[:, 1] - degrees[0, 1] + 180) % 360 - 180  # the 180th meridian is no gap
    origin = degrees.mean(0)
    metres = pycolmap.GPSTransform().ellipsoid_to_enu(degrees, *origin)
    origin[1] = (origin[1] + 180) % 360 - 180
    return tuple(origin.tolist()), torch.from_numpy(metres)
