"""Paths of synthetic cameras: a curve through the scene, and poses at equal steps along it.

World frame: x, y horizontal, z up, metres. A heading of 0 looks along +x; positive headings turn left.
"""

import math
from dataclasses import dataclass

import numpy as np

from padgs.data.synthetic.options import SyntheticOptions
from padgs.data.synthetic.textures import Array

_DENSE = 2000  # vertices of the polyline of a curve


@dataclass(frozen=True)
class Walk:
    """Free space for cameras in a scene: a rectangle, and optionally a route through waypoints."""

    center: tuple[float, float]
    half: tuple[float, float]
    height: float = 1.5  # of the cameras
    sway: float = 0.12  # amplitude of their vertical motion
    waypoints: tuple[tuple[float, float], ...] = ()  # closed; replaces the roaming curve


def curve(walk: Walk, kind: str, rng: np.random.Generator) -> Array:
    """Return dense points [n, 3] along a path of the given kind (roaming, cross, line)."""
    phases = rng.uniform(0, 2 * math.pi, 4)
    s = np.linspace(0, 1, _DENSE, endpoint=kind != "roaming")
    angle = 2 * math.pi * s
    heights = walk.height + walk.sway * np.sin(3 * angle + phases[3])
    if kind == "roaming" and walk.waypoints:
        return np.column_stack((_closed_spline(np.asarray(walk.waypoints), s), heights))
    if kind == "roaming":  # a randomly bent figure of eight
        x = np.sin(angle) + 0.15 * np.sin(3 * angle + phases[0])
        y = np.sin(2 * angle + 0.4 * math.sin(phases[1])) + 0.2 * np.cos(angle + phases[2])
        x, y = x / np.abs(x).max(), y / np.abs(y).max()
    elif kind == "cross":
        arm = np.abs((2 * s) % 1 * 2 - 1) * np.where((2 * s) % 1 < 0.5, -1, 1)
        x, y = np.where(s < 0.5, arm, 0), np.where(s < 0.5, 0, arm)
    else:
        x, y = 2 * s - 1, 0.08 * np.sin(2 * angle + phases[0])
    return np.column_stack((np.column_stack((x, y)) * walk.half + walk.center, heights))


def _closed_spline(points: Array, s: Array) -> Array:
    """Evaluate the closed Catmull-Rom spline through waypoints [k, 2] at s in [0, 1); segments have equal lengths."""
    t = s * len(points)
    segment, f = np.floor(t).astype(int), (t % 1)[:, None]
    p0, p1, p2, p3 = (points[(segment + k) % len(points)] for k in (-1, 0, 1, 2))
    return p1 + 0.5 * f * (p2 - p0 + f * (2 * p0 - 5 * p1 + 4 * p2 - p3 + f * (3 * (p1 - p2) + p3 - p0)))


def stations(path: Array, count: int) -> tuple[Array, Array]:
    """Return `count` positions [count, 3] at equal arc length on a dense path, and its headings [count] there."""
    jumps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    jumps[jumps > 20 * np.median(jumps)] = 0  # from one arm of the cross to the next
    length = np.concatenate(([0.0], np.cumsum(jumps)))
    at = (np.arange(count) + 0.5) / count * length[-1]
    positions = np.column_stack([np.interp(at, length, component) for component in path.T])
    index = np.clip(np.searchsorted(length, at), 2, len(path) - 3)
    ahead = path[index + 2] - path[index - 2]
    return positions, np.arctan2(ahead[:, 1], ahead[:, 0])


def cam_from_world(position: Array, heading: float, roll: float = 0.0, pitch: float = 0.0) -> Array:
    """Return the pose [4, 4] of a camera at a position [3]; angles in radians.

    >>> (cam_from_world(np.zeros(3), 0.0) @ [2, 0, 0, 1]).tolist()  # forward is camera z
    [0.0, 0.0, 2.0, 1.0]
    """
    c, s = math.cos(heading), math.sin(heading)
    upright = np.array(((s, -c, 0.0), (0.0, 0.0, -1.0), (c, s, 0.0)))  # right, down, forward
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    about_z = np.array(((cr, -sr, 0.0), (sr, cr, 0.0), (0.0, 0.0, 1.0)))
    about_x = np.array(((1.0, 0.0, 0.0), (0.0, cp, -sp), (0.0, sp, cp)))
    pose = np.eye(4)
    pose[:3, :3] = about_z @ about_x @ upright
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose + 0.0  # no negative zeros


def poses(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> Array:
    """Return the poses [n, 4, 4] of all training and test views, in order along the path."""
    count = options.train_views + options.test_views
    positions, headings = stations(path, count)
    if options.heading != "path":
        headings = np.zeros(count) if options.heading == "fixed" else rng.uniform(-math.pi, math.pi, count)
    roll, pitch = np.radians(options.tilt) * rng.standard_normal((2, count))
    return np.stack([cam_from_world(*args) for args in zip(positions, headings, roll, pitch, strict=True)])


def held_out(options: SyntheticOptions) -> list[int]:
    """Return the positions of the test views along the path: spread evenly, without the ends if there are few."""
    total = options.train_views + options.test_views
    return [int((k + 0.5) * total / options.test_views) for k in range(options.test_views)]
