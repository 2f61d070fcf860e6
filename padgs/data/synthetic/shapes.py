"""Solids of synthetic scenes, with closed-form ray intersections.

Arrays are component-first, [3, n], because numpy is fastest on contiguous components. World axes: x, y horizontal,
z up, metres.

Every shape has `materials` (one per face, or one for all), `bounds` (centre and radius of a bounding sphere; None if it
surrounds the camera), and two functions. `hit` returns distances [n] along unit directions [3, n] from origins
[3, 1 or n] to the first hit, inf for none, in the precision of the directions (float32 for colour, float64 for exact
depth). `surface` returns normals, texture coordinates and faces of points [3, n] on the shape.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from padgs.data.synthetic.textures import Array, Texture

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """Appearance of a surface."""

    texture: Texture
    reflectance: float = 0.0  # at normal incidence: 0 = matt, 1 = mirror
    glows: bool = False  # unlit, and casts no shadow


@dataclass(frozen=True)
class Surface:
    """Surface properties at ray hits."""

    normal: Array  # [3, n] towards the visible side
    uv: Array  # [2, n] metres from the centre of the face
    face: Array  # [n] int, index into the shape's materials


def _column(point: Point | Array, like: Array) -> Array:
    return np.asarray(point, like.dtype).reshape(3, 1)


def _rotated(vectors: Array, yaw: float) -> Array:
    """Rotate vectors [3, n] about the vertical, to the left."""
    if yaw == 0:
        return vectors
    c, s = math.cos(yaw), math.sin(yaw)
    return np.stack((c * vectors[0] - s * vectors[1], c * vectors[1] + s * vectors[0], vectors[2]))


_FACE_AXES = np.array(((1, 1, 0, 0, 0, 0), (2, 2, 2, 2, 1, 1)))  # coordinates of u and v
_FACE_NORMALS = np.array(((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)))
_FACE_SIGNS = np.array((-1, 1, 1, -1, 1, 1))  # of u, seen from outside


def _face_uv(local: Array, face: Array, side: float) -> Array:
    """Return texture coordinates on the six faces of a box; `side` = 1 seen from outside, -1 from inside."""
    first, second = _FACE_AXES[:, face]
    sign = (_FACE_SIGNS * side).astype(local.dtype)  # floors and ceilings are not mirrored
    sign[4:] = 1
    columns = np.arange(local.shape[1])
    return np.stack((sign[face] * local[first, columns], local[second, columns]))


def _face_normal(face: Array, dtype: np.dtype) -> Array:
    return _FACE_NORMALS.astype(dtype)[face].T


@dataclass(frozen=True)
class Room:
    """Inside of an axis-aligned box. Faces in the order -x, +x, -y, +y, -z (floor), +z (ceiling)."""

    low: Point
    high: Point
    materials: tuple[Material, ...]

    bounds = None
    texel, faces = 0.08, 6  # texel: metres, of the light map of each face

    def hit(self, origin: Array, direction: Array) -> Array:
        low, high = _column(self.low, direction), _column(self.high, direction)
        wall = np.where(direction > 0, high - origin, low - origin)
        t = np.divide(wall, direction, out=np.full_like(wall, np.inf), where=direction != 0)
        return t.min(0)

    def surface(self, points: Array) -> Surface:
        gaps = np.empty((6, points.shape[1]), points.dtype)
        gaps[0::2], gaps[1::2] = points - _column(self.low, points), _column(self.high, points) - points
        face = np.argmin(np.abs(gaps), axis=0)
        local = points - self._middle(points)
        return Surface(-_face_normal(face, points.dtype), _face_uv(local, face, -1), face)

    def size(self, face: int) -> tuple[float, float]:
        """Return the extent (u, v) of a face in metres."""
        extent = np.subtract(self.high, self.low)
        return ((extent[1], extent[2]), (extent[0], extent[2]), (extent[0], extent[1]))[face // 2]

    def point_at(self, face: int, uv: Array) -> Array:
        """Return the points [3, n] of a face at texture coordinates [2, n]: the inverse of `surface`."""
        axis, sign = face // 2, 1.0 if face % 2 else -1.0
        points = np.empty((3, uv.shape[1]), uv.dtype)
        points[axis] = sign * (self.high[axis] - self.low[axis]) / 2
        points[(1, 0, 0)[axis]] = uv[0] * (-sign if axis == 0 else sign if axis == 1 else 1.0)
        points[(2, 2, 1)[axis]] = uv[1]
        return points + self._middle(points)

    def _middle(self, like: Array) -> Array:
        return _column((np.asarray(self.low) + np.asarray(self.high)) / 2, like)


@dataclass(frozen=True)
class Box:
    """Box, rotated about the vertical. Faces as in Room; a single material covers all faces."""

    center: Point
    half: Point
    materials: tuple[Material, ...]
    yaw: float = 0.0  # rad

    @property
    def bounds(self) -> tuple[Point, float]:
        return self.center, math.hypot(*self.half)

    def hit(self, origin: Array, direction: Array) -> Array:
        start, ray = _rotated(origin - _column(self.center, direction), -self.yaw), _rotated(direction, -self.yaw)
        half = _column(self.half, direction)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / ray
            middle, reach = -start * inverse, np.abs(half * inverse)
            near, far = middle - reach, middle + reach
        enter = np.fmax(np.fmax(near[0], near[1]), near[2])
        leave = np.fmin(np.fmin(far[0], far[1]), far[2])
        return np.where((enter <= leave) & (enter > 0), enter, np.inf)

    def surface(self, points: Array) -> Surface:
        local = _rotated(points - _column(self.center, points), -self.yaw)
        outside = np.abs(local) - _column(self.half, points)
        axis = np.argmax(outside, axis=0)
        face = 2 * axis + (np.take_along_axis(local, axis[None], 0)[0] > 0)
        return Surface(_rotated(_face_normal(face, points.dtype), self.yaw), _face_uv(local, face, 1), face)


@dataclass(frozen=True)
class Sphere:
    """Sphere. uv = (longitude, latitude) x radius."""

    center: Point
    radius: float
    materials: tuple[Material, ...]

    @property
    def bounds(self) -> tuple[Point, float]:
        return self.center, self.radius

    def hit(self, origin: Array, direction: Array) -> Array:
        start = origin - _column(self.center, direction)
        along = (start * direction).sum(0)
        miss = start - along * direction  # from the centre to the ray: no cancellation, unlike |start|^2 - r^2
        inside = self.radius**2 - (miss * miss).sum(0)
        t = -along - np.sqrt(np.maximum(inside, 0))
        return np.where((inside > 0) & (t > 0), t, np.inf)

    def surface(self, points: Array) -> Surface:
        normal = (points - _column(self.center, points)) / np.asarray(self.radius, points.dtype)
        latitude = np.arcsin(np.clip(normal[2], -1, 1))
        uv = np.stack((np.arctan2(normal[1], normal[0]), latitude)) * np.asarray(self.radius, points.dtype)
        return Surface(normal, uv, np.zeros(points.shape[1], np.int64))


@dataclass(frozen=True)
class Rod:
    """Cylinder from `start` to `end`, open or with spherical ends. uv = (angle x radius, length along)."""

    start: Point
    end: Point
    radius: float
    materials: tuple[Material, ...]
    rounded: bool = False  # not needed if both ends are inside other shapes

    @property
    def bounds(self) -> tuple[Point, float]:
        a, b = np.asarray(self.start), np.asarray(self.end)
        return tuple((a + b) / 2), float(np.linalg.norm(b - a)) / 2 + self.radius

    @cached_property
    def _axis(self) -> tuple[Array, float]:
        span = np.subtract(self.end, self.start)
        length = float(np.linalg.norm(span))
        return span / length, length

    def hit(self, origin: Array, direction: Array) -> Array:
        unit, length = self._axis
        axis = _column(unit, direction)
        start = origin - _column(self.start, direction)
        ray_along, start_along = axis[:, 0] @ direction, axis[:, 0] @ start
        ray_across, start_across = direction - ray_along * axis, start - start_along * axis
        a = (ray_across * ray_across).sum(0)
        b = (ray_across * start_across).sum(0)
        with np.errstate(divide="ignore", invalid="ignore"):
            miss = start_across - (b / a) * ray_across
            inside = self.radius**2 - (miss * miss).sum(0)
            t = (-b - np.sqrt(np.maximum(inside, 0) * a)) / a
            height = start_along + t * ray_along
        side = np.where((inside > 0) & (t > 0) & (height >= 0) & (height <= length), t, np.inf)
        if not self.rounded:
            return side
        ends = (Sphere(end, self.radius, ()).hit(origin, direction) for end in (self.start, self.end))
        return np.minimum(side, np.minimum(*ends))

    def surface(self, points: Array) -> Surface:
        unit, length = self._axis
        axis = _column(unit, points)
        start = points - _column(self.start, points)
        along = (axis * start).sum(0)
        normal = (start - np.clip(along, 0, length) * axis) / np.asarray(self.radius, points.dtype)
        helper = np.eye(3)[int(np.argmin(np.abs(unit)))]
        first = np.cross(unit, helper)
        first /= np.linalg.norm(first)
        second = np.cross(unit, first)
        angle = np.arctan2(*((_column(e, points) * normal).sum(0) for e in (second, first)))
        uv = np.stack((angle * np.asarray(self.radius, points.dtype), along))
        return Surface(normal, uv, np.zeros(points.shape[1], np.int64))


@dataclass(frozen=True)
class Ground:
    """Plane z = 0, seen from above. Its light map covers the middle."""

    materials: tuple[Material, ...]

    bounds = None
    texel, faces = 0.15, 1  # as in Room

    def hit(self, origin: Array, direction: Array) -> Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -origin[2] / direction[2]
        return np.where((direction[2] < 0) & (t > 0), t, np.inf)

    def surface(self, points: Array) -> Surface:
        normal = np.zeros_like(points)
        normal[2] = 1
        return Surface(normal, points[:2], np.zeros(points.shape[1], np.int64))

    def size(self, face: int) -> tuple[float, float]:
        return 64.0, 64.0

    def point_at(self, face: int, uv: Array) -> Array:
        return np.concatenate((uv, np.zeros_like(uv[:1])))


@dataclass(frozen=True)
class Ring:
    """Inside of a cylinder about the z axis with a jagged top: distant mountains."""

    radius: float
    height: float  # of the highest peaks
    materials: tuple[Material, ...]

    bounds = None

    def ridge(self, angle: Array) -> Array:
        """Return the height of the top at an azimuth in radians; periodic."""
        waves = np.sum([np.sin(k * angle + 1.7 * k * k) / k for k in (2, 3, 5, 9, 17, 31)], axis=0)
        return self.height * (0.55 + 0.3 * waves)

    def hit(self, origin: Array, direction: Array) -> Array:
        a = direction[0] ** 2 + direction[1] ** 2
        b = origin[0] * direction[0] + origin[1] * direction[1]
        c = origin[0] ** 2 + origin[1] ** 2 - self.radius**2
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (-b + np.sqrt(b * b - a * c)) / a
            x, y, z = origin + t * direction
            return np.where((z >= 0) & (z < self.ridge(np.arctan2(y, x))), t, np.inf)

    def surface(self, points: Array) -> Surface:
        normal = -points / np.asarray(self.radius, points.dtype)
        normal[2] = 0
        angle = np.arctan2(points[1], points[0])
        return Surface(normal, np.stack((angle * self.radius, points[2])), np.zeros(points.shape[1], np.int64))


Shape = Room | Box | Sphere | Rod | Ground | Ring
Flat = Room | Ground  # shapes with light maps
