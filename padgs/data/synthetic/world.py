"""A synthetic world: shapes and light, and what a ray sees in it.

Light is simple but soft: lamps of some size with inverse falloff, an ambient term, contact darkening; the faces of
rooms carry light maps with true soft shadows and ambient occlusion. Mirror-like materials show one reflection.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from padgs.data.synthetic.shapes import Point, Room, Shape
from padgs.data.synthetic.textures import Array, Color, bilinear

SKY = -1  # object id of a ray that hits nothing
_TEXEL = 0.08  # metres, of the light maps


@dataclass(frozen=True)
class Light:
    """Lamps (position, strength), their colour, and the colour of the light from everywhere."""

    lamps: tuple[tuple[Point, float], ...]
    color: Color = (1.0, 0.95, 0.86)
    ambient: Color = (0.36, 0.38, 0.42)
    size: float = 0.25  # radius of a lamp: softness of its shadows


@dataclass
class World:
    """Shapes in a fixed order (the index is the object id), light, and the sky for rays that leave."""

    shapes: tuple[Shape, ...]
    light: Light
    sky: Callable[[Array], Array] | None = None  # directions [3, n] -> colours [3, n]
    light_maps: dict[tuple[int, int], tuple[Array, Array]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        """Bake the light maps of rooms."""
        for index, shape in enumerate(self.shapes):
            if isinstance(shape, Room):
                for face in range(6):
                    self.light_maps[index, face] = self._bake(shape, face)

    def nearest(self, origin: Array, direction: Array, candidates: Sequence[int] | None = None) -> tuple[Array, Array]:
        """Distance [n] (inf where nothing is hit) and object id [n] (SKY there) of the first hit.

        Args:
            origin: [3, 1] or [3, n] metres.
            direction: [3, n] unit, float32 or float64.
            candidates: shapes to try; all of them if None.
        """
        distance = np.full(direction.shape[1], np.inf, direction.dtype)
        object_id = np.full(direction.shape[1], SKY, np.int16)
        for index in range(len(self.shapes)) if candidates is None else candidates:
            t = self.shapes[index].hit(origin, direction)
            closer = t < distance
            np.copyto(distance, t, where=closer)
            np.copyto(object_id, np.int16(index), where=closer)
        return distance, object_id

    def within(self, origin: Array, axis: Array, half_angle: float) -> list[int]:
        """Shapes that a ray from `origin` [3] within `half_angle` of `axis` [3] may hit."""
        centers, radii = self._bounds
        toward = centers - origin
        far = np.sqrt((toward * toward).sum(1)) + 1e-9
        angle = np.arccos(np.clip(toward @ axis / far, -1, 1)) - np.arcsin(np.minimum(radii / far, 1))
        return np.flatnonzero((angle <= half_angle) | (far <= radii)).tolist()

    @cached_property
    def _bounds(self) -> tuple[Array, Array]:
        bounds = [shape.bounds or ((0.0, 0.0, 0.0), np.inf) for shape in self.shapes]
        return np.array([center for center, _ in bounds]), np.array([radius for _, radius in bounds])

    def color(
        self, origin: Array, direction: Array, candidates: Sequence[int] | None = None, *, reflect: bool = True
    ) -> Array:
        """Colour [3, n] seen along rays (arguments as in `nearest`)."""
        distance, object_id = self.nearest(origin, direction, candidates)
        points = origin + np.where(object_id == SKY, 0, distance) * direction
        seen = np.empty(direction.shape, np.float32)
        for index, where in _groups(object_id):
            if index == SKY:
                seen[:, where] = 0 if self.sky is None else self.sky(direction[:, where])
            else:
                seen[:, where] = self._surface_color(index, points[:, where], direction[:, where], reflect)
        return seen

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
            normal = surface.normal[:, where]
            lit = albedo * self._irradiance((index, face), points[:, where], surface.uv[:, where], normal)
            if material.reflectance and reflect:
                incoming = ray[:, where]
                cosine = -(normal * incoming).sum(0)
                share = material.reflectance + (1 - material.reflectance) * np.clip(1 - cosine, 0, 1) ** 5
                bounced = incoming + 2 * cosine * normal
                mirror = self.color(points[:, where] + 1e-3 * normal, bounced, reflect=False)
                lit = lit + share * (mirror - lit)
            color[:, where] = lit
        return color

    def _irradiance(self, face: tuple[int, int], points: Array, uv: Array, normal: Array) -> Array:
        if face in self.light_maps:
            direct_map, open_map = self.light_maps[face]
            rows, columns = direct_map.shape
            shape = self.shapes[face[0]]
            assert isinstance(shape, Room)
            width, height = shape.size(face[1])
            x = np.clip((uv[0] / width + 0.5) * columns - 0.5, 0, columns - 1.001)
            y = np.clip((uv[1] / height + 0.5) * rows - 0.5, 0, rows - 1.001)
            direct, openness = bilinear(direct_map, x, y), bilinear(open_map, x, y)
        else:
            direct = sum(self._lambert(points, normal, lamp, power) for lamp, power in self.light.lamps)
            openness = 1 - 0.4 * np.exp(-np.maximum(points[2], 0) / 0.15)
        ambient = np.asarray(self.light.ambient, np.float32)[:, None] * (openness * (0.85 + 0.15 * normal[2]))
        return ambient + np.asarray(self.light.color, np.float32)[:, None] * direct

    @staticmethod
    def _lambert(points: Array, normal: Array, lamp: Point | Array, power: float) -> Array:
        toward = np.asarray(lamp, points.dtype).reshape(3, -1) - points
        far = np.sqrt((toward * toward).sum(0))
        return power * np.maximum((toward * normal).sum(0) / far, 0) / (1 + 0.25 * far)

    def _bake(self, room: Room, face: int) -> tuple[Array, Array]:
        """Light maps [rows, columns] of one face: direct light with soft shadows, and openness to ambient light."""
        rng = np.random.default_rng(face)
        width, height = room.size(face)
        columns, rows = (max(4, int(np.ceil(extent / _TEXEL))) for extent in (width, height))
        u, v = (
            ((np.arange(count) + 0.5) / count - 0.5) * extent for count, extent in ((columns, width), (rows, height))
        )
        uv = np.stack([axis.ravel() for axis in np.meshgrid(u, v)]).astype(np.float32)
        points = room.point_at(face, uv)
        normal = room.surface(points).normal
        start = points + 2e-3 * normal
        casting = [i for i, s in enumerate(self.shapes) if s is not room and not s.materials[0].glows]
        direct = np.zeros(points.shape[1], np.float32)
        samples = 8
        for lamp, power in self.light.lamps:
            for offset in self.light.size * _on_sphere(samples):
                target = (np.asarray(lamp) + offset).astype(np.float32).reshape(3, 1)
                toward = target - start
                far = np.sqrt((toward * toward).sum(0))
                blocked = self.nearest(start, toward / far, casting)[0] < far
                direct += np.where(blocked, 0, self._lambert(points, normal, target, power / samples))
        openness = np.zeros_like(direct)
        tangent = np.eye(3, dtype=np.float32)[:, [(face // 2 + 1) % 3]]
        other = np.cross(normal[:, :1], tangent, axis=0)
        for radius, angle in zip(np.sqrt((np.arange(12) + 0.5) / 12), 2.4 * np.arange(12) + rng.random(), strict=True):
            ray = radius * (np.cos(angle) * tangent + np.sin(angle) * other) + np.sqrt(1 - radius**2) * normal
            free = self.nearest(start, ray.astype(np.float32))[0]
            openness += np.minimum(free / 0.9, 1) / 12
        return _smooth(direct.reshape(rows, columns)), _smooth(openness.reshape(rows, columns))


def _groups(labels: Array) -> Iterator[tuple[int, Array | slice]]:
    """Each label that occurs, and where; a slice of everything where it is the only one."""
    low, high = int(labels.min()), int(labels.max())
    if low == high:
        yield low, slice(None)
        return
    for label in np.flatnonzero(np.bincount(labels - low)) + low:
        yield int(label), np.flatnonzero(labels == label)


def _on_sphere(count: int) -> Array:
    """Evenly spread unit vectors [count, 3]: a golden spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * (np.pi * (3 - np.sqrt(5)))
    radius = np.sqrt(1 - z * z)
    return np.stack((radius * np.cos(angle), radius * np.sin(angle), z), axis=1)


def _smooth(table: Array) -> Array:
    """A 3 x 3 binomial blur: hides that shadows come from a few samples."""
    for _ in range(2):
        padded = np.pad(table, ((1, 1), (0, 0)), mode="edge")
        table = ((padded[:-2] + padded[2:]) / 4 + table / 2).T
    return np.ascontiguousarray(table, np.float32)
