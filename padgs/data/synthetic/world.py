"""Synthetic worlds: shapes and light, and the colour along a ray.

Flat faces (of rooms and the ground) have light maps: the direct light with true soft shadows, and the openness to
ambient light (ambient occlusion), the same from all views. Other shapes are lit without shadows, and darkened near the
floor. Mirror-like materials show one reflection.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from padgs.data.synthetic.shapes import Flat, Point, Shape
from padgs.data.synthetic.textures import Array, Color, bilinear

SKY = -1  # object id of a ray that hits nothing
_OCCLUSION_RADIUS = 0.9  # metres
_LAMP_SAMPLES, _OPEN_SAMPLES = 8, 12
_TILE = 16  # texels; rays of a tile share a list of candidate shapes


@dataclass(frozen=True)
class Light:
    """Lamps (position, strength), their colour, and the ambient colour."""

    lamps: tuple[tuple[Point, float], ...]
    color: Color = (1.0, 0.95, 0.86)
    ambient: Color = (0.46, 0.48, 0.52)
    size: float = 0.25  # radius of a lamp, which softens shadows

    def direct(self, points: Array, normal: Array) -> Array:
        """Return the unshadowed direct light [n] on points [3, n] with the given normals."""
        return np.sum([lambert(points, normal, np.asarray(lamp), power) for lamp, power in self.lamps], axis=0)


def lambert(points: Array, normal: Array, lamp: Array, power: float) -> Array:
    """Return the light [n] of one lamp at [3]: cosine law, with a slower falloff than in nature."""
    toward = lamp.astype(points.dtype).reshape(3, 1) - points
    far = np.sqrt((toward * toward).sum(0))
    return power * np.maximum((toward * normal).sum(0) / far, 0) / (1 + 0.25 * far)


@dataclass(frozen=True)
class LightMap:
    """Direct light and openness [rows, columns] over a flat face of a size in metres."""

    direct: Array
    openness: Array
    size: tuple[float, float]

    def at(self, uv: Array) -> tuple[Array, Array]:
        """Return direct light [n] and openness [n] at texture coordinates [2, n], clamped to the face."""
        rows, columns = self.direct.shape
        x = np.clip((uv[0] / self.size[0] + 0.5) * columns - 0.5, 0, columns - 1.001)
        y = np.clip((uv[1] / self.size[1] + 0.5) * rows - 0.5, 0, rows - 1.001)
        return bilinear(self.direct, x, y), bilinear(self.openness, x, y)


def bake(world: World, flat: Flat, face: int) -> LightMap:
    """Compute the light map of a face."""
    width, height = flat.size(face)
    columns, rows = (int(np.ceil(extent / flat.texel / 2)) * 2 + 1 for extent in (width, height))  # odd: not periodic
    direct, openness = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.float32)
    for i in range(0, rows, _TILE):
        for j in range(0, columns, _TILE):
            tile = np.s_[i : min(i + _TILE, rows), j : min(j + _TILE, columns)]
            v, u = np.mgrid[tile].reshape(2, -1) + 0.5
            uv = np.stack(((u / columns - 0.5) * width, (v / rows - 0.5) * height)).astype(np.float32)
            points = flat.point_at(face, uv)
            normal = flat.surface(points).normal
            shape = direct[tile].shape
            direct[tile] = _direct(world, points, normal).reshape(shape)
            openness[tile] = _openness(world, points, normal).reshape(shape)
    return LightMap(_smooth(direct), _smooth(openness), (width, height))


def _direct(world: World, points: Array, normal: Array) -> Array:
    middle, spread = _ball(points)
    light, (centers, radii) = world.light, world.bounds
    casts = np.array([not isinstance(s, Flat) and not s.materials[0].glows for s in world.shapes])
    total = np.zeros(points.shape[1], np.float32)
    for lamp, power in light.lamps:
        position = np.asarray(lamp)
        line = position - middle
        along = np.clip((centers - middle) @ line / (line @ line), 0, 1)
        gap = np.linalg.norm(centers - middle - along[:, None] * line, axis=1)
        between = np.flatnonzero(casts & (gap < radii + spread + light.size)).tolist()
        unshadowed = lambert(points, normal, position, power)
        if not between:
            total += unshadowed
            continue
        targets = (position + light.size * sphere_points(_LAMP_SAMPLES)).T.astype(np.float32)
        start, toward = _all_pairs(points + np.float32(2e-3) * normal, targets)
        toward = toward - start
        far = np.sqrt((toward * toward).sum(0))
        lit = world.nearest(start, toward / far, between)[0] >= far
        total += unshadowed * lit.reshape(points.shape[1], -1).mean(1)
    return total


def _openness(world: World, points: Array, normal: Array) -> Array:
    middle, spread = _ball(points)
    centers, radii = world.bounds
    near = np.flatnonzero(np.linalg.norm(centers - middle, axis=1) < radii + spread + _OCCLUSION_RADIUS).tolist()
    up = normal[:, 0]
    first = np.roll(np.abs(np.round(up)), 1)
    second = np.cross(up, first)
    steps = np.arange(_OPEN_SAMPLES)
    radius, angle = np.sqrt((steps + 0.5) / _OPEN_SAMPLES), 2.4 * steps  # a cosine-weighted spiral
    directions = np.outer(first, radius * np.cos(angle)) + np.outer(second, radius * np.sin(angle))
    directions += np.outer(up, np.sqrt(1 - radius**2))
    start, rays = _all_pairs(points + np.float32(2e-3) * normal, directions.astype(np.float32))
    free = np.minimum(world.nearest(start, rays, near)[0] / _OCCLUSION_RADIUS, 1)
    return free.reshape(points.shape[1], -1).mean(1)


def _all_pairs(first: Array, second: Array) -> tuple[Array, Array]:
    """Return all pairs of the columns of [3, n] and [3, k]: twice [3, n * k]."""
    return np.repeat(first, second.shape[1], axis=1), np.tile(second, first.shape[1])


def _ball(points: Array) -> tuple[Array, float]:
    """Return centre [3] and radius of a ball around points [3, n]."""
    middle = points.mean(1).astype(np.float64)
    return middle, float(np.sqrt(((points - middle[:, None]) ** 2).sum(0).max()))


def sphere_points(count: int) -> Array:
    """Return evenly spread unit vectors [count, 3]: a golden spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * (np.pi * (3 - np.sqrt(5)))
    radius = np.sqrt(1 - z * z)
    return np.stack((radius * np.cos(angle), radius * np.sin(angle), z), axis=1)


def _smooth(table: Array) -> Array:
    """Apply a 3 x 3 binomial blur, which hides the noise of few shadow samples."""
    for _ in range(2):
        padded = np.pad(table, ((1, 1), (0, 0)), mode="edge")
        table = ((padded[:-2] + padded[2:]) / 4 + table / 2).T
    return np.ascontiguousarray(table, np.float32)


@dataclass
class World:
    """Shapes in a fixed order (the index is the object id), light, and sky."""

    shapes: tuple[Shape, ...]
    light: Light
    sky: Callable[[Array], Array] | None = None  # directions [3, n] -> colours [3, n]

    @cached_property
    def light_maps(self) -> dict[tuple[int, int], LightMap]:
        """Light maps by shape and face; baked when colours are first needed."""
        flat = [(index, shape) for index, shape in enumerate(self.shapes) if isinstance(shape, Flat)]
        return {(index, face): bake(self, shape, face) for index, shape in flat for face in range(shape.faces)}

    def joined_by(self, shapes: Sequence[Shape]) -> World:
        """Return the world with more shapes, which cast no shadows."""
        world = replace(self, shapes=(*self.shapes, *shapes))
        world.light_maps = self.light_maps
        return world

    def nearest(self, origin: Array, direction: Array, candidates: Sequence[int] | None = None) -> tuple[Array, Array]:
        """Return distance [n] (inf if nothing is hit) and object id [n] (then SKY) of the first hit.

        Rays are as in `Shape.hit`; `candidates` are the indices of shapes to test, all if None.
        """
        distance = np.full(direction.shape[1], np.inf, direction.dtype)
        object_id = np.full(direction.shape[1], SKY, np.int16)
        for index in range(len(self.shapes)) if candidates is None else candidates:
            t = self.shapes[index].hit(origin, direction)
            closer = t < distance
            np.copyto(distance, t, where=closer)
            np.copyto(object_id, np.int16(index), where=closer)
        return distance, object_id

    def color(
        self, origin: Array, direction: Array, candidates: Sequence[int] | None = None, *, reflect: bool = True
    ) -> Array:
        """Return colours [3, n] float32 along rays [3, n]; `candidates` None: the shapes that the bundle can hit."""
        if candidates is None:
            candidates = self._within(origin, direction)
        distance, object_id = self.nearest(origin, direction, candidates)
        points = origin + np.where(object_id == SKY, 0, distance) * direction
        seen = np.empty(direction.shape, np.float32)
        for index, where in _groups(object_id):
            if index == SKY:
                seen[:, where] = 0 if self.sky is None else self.sky(direction[:, where])
            else:
                seen[:, where] = self._surface_color(index, points[:, where], direction[:, where], reflect)
        return seen

    def _within(self, origin: Array, direction: Array) -> list[int]:
        """Return the shapes whose bounding sphere meets the cone around a bundle of rays."""
        middle = origin.mean(1)
        spread = float(np.sqrt(((origin - middle[:, None]) ** 2).sum(0).max()))
        axis = direction.mean(1)
        length = float(np.sqrt(axis @ axis))
        if length < 1e-3:  # rays in all directions
            return list(range(len(self.shapes)))
        axis = axis / length
        half_angle = np.arccos(np.clip((axis @ direction).min(), -1, 1)) + 1e-3
        centers, radii = self.bounds
        toward, radii = centers - middle, radii + spread
        far = np.sqrt((toward * toward).sum(1)) + 1e-9
        angle = np.arccos(np.clip(toward @ axis / far, -1, 1)) - np.arcsin(np.minimum(radii / far, 1))
        return np.flatnonzero((angle <= half_angle) | (far <= radii)).tolist()

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Return centres [k, 3] and radii [k] of all bounding spheres; infinite if a shape surrounds the camera."""
        bounds = [shape.bounds or ((0.0, 0.0, 0.0), np.inf) for shape in self.shapes]
        return np.array([center for center, _ in bounds]), np.array([radius for _, radius in bounds])

    def _surface_color(self, index: int, points: Array, ray: Array, reflect: bool) -> Array:
        shape = self.shapes[index]
        surface = shape.surface(points)
        color = np.empty(points.shape, np.float32)
        several = len(shape.materials) > 1
        for face, where in _groups(surface.face):
            material = shape.materials[face if several else 0]
            albedo = material.texture(surface.uv[:, where])
            if material.glows:
                color[:, where] = albedo
                continue
            normal, position = surface.normal[:, where], points[:, where]
            lit = albedo * self._irradiance(self.light_maps.get((index, face)), position, surface.uv[:, where], normal)
            if material.reflectance and reflect:
                incoming = ray[:, where]
                cosine = -(normal * incoming).sum(0)
                share = material.reflectance + (1 - material.reflectance) * np.clip(1 - cosine, 0, 1) ** 5
                bounced = incoming + 2 * cosine * normal
                mirror = self.color(position + np.float32(1e-3) * normal, bounced, reflect=False)
                lit = lit + share * (mirror - lit)
            color[:, where] = lit
        return color

    def _irradiance(self, light_map: LightMap | None, points: Array, uv: Array, normal: Array) -> Array:
        if light_map is not None:
            direct, openness = light_map.at(uv)
        else:
            direct = self.light.direct(points, normal)
            openness = 1 - 0.4 * np.exp(-np.maximum(points[2], 0) / 0.15)
        ambient = np.asarray(self.light.ambient, np.float32)[:, None] * (openness * (0.95 + 0.05 * normal[2]))
        return ambient + np.asarray(self.light.color, np.float32)[:, None] * direct


def _groups(labels: Array) -> Iterator[tuple[int, Array | slice]]:
    """Yield each label and its positions; a full slice if there is only one label."""
    low, high = int(labels.min()), int(labels.max())
    if low == high:
        yield low, slice(None)
        return
    for label in np.flatnonzero(np.bincount(labels - low)) + low:
        yield int(label), np.flatnonzero(labels == label)
