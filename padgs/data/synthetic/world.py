"""A synthetic world: shapes and light, and what a ray sees in it.

Flat faces of rooms and the ground carry light maps; everything else is lit by its lamps without shadows and darkened
near the floor. Mirror-like materials show one reflection.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from padgs.data.synthetic.light import Light, LightMap, bake
from padgs.data.synthetic.shapes import Flat, Shape
from padgs.data.synthetic.textures import Array

SKY = -1  # object id of a ray that hits nothing


@dataclass
class World:
    """Shapes in a fixed order (the index is the object id), light, and the sky for rays that leave."""

    shapes: tuple[Shape, ...]
    light: Light
    sky: Callable[[Array], Array] | None = None  # directions [3, n] -> colours [3, n]
    light_maps: dict[tuple[int, int], LightMap] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        casts = np.array([not isinstance(s, Flat) and not s.materials[0].glows for s in self.shapes])
        for index, shape in enumerate(self.shapes):
            if isinstance(shape, Flat):
                for face in range(shape.faces):
                    light_map = bake(shape, face, self.light, self._bounds, casts, lambda *a: self.nearest(*a)[0])
                    self.light_maps[index, face] = light_map

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

    def color(
        self, origin: Array, direction: Array, candidates: Sequence[int] | None = None, *, reflect: bool = True
    ) -> Array:
        """Colour [3, n] float32 seen along rays [3, n] float32 from [3, 1] or [3, n], best a narrow bundle.

        Args:
            origin: metres.
            direction: unit.
            candidates: shapes to try; those that the bundle can hit if None.
            reflect: whether mirror-like surfaces show what they reflect.
        """
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
        """Shapes that a bundle of rays may hit: those whose bounding sphere meets the cone around it."""
        middle = origin.mean(1)
        spread = float(np.sqrt(((origin - middle[:, None]) ** 2).sum(0).max()))
        axis = direction.mean(1)
        length = float(np.sqrt(axis @ axis))
        if length < 1e-3:  # rays in all directions
            return list(range(len(self.shapes)))
        axis = axis / length
        half_angle = np.arccos(np.clip((axis @ direction).min(), -1, 1)) + 1e-3
        centers, radii = self._bounds
        toward, radii = centers - middle, radii + spread
        far = np.sqrt((toward * toward).sum(1)) + 1e-9
        angle = np.arccos(np.clip(toward @ axis / far, -1, 1)) - np.arcsin(np.minimum(radii / far, 1))
        return np.flatnonzero((angle <= half_angle) | (far <= radii)).tolist()

    @cached_property
    def _bounds(self) -> tuple[Array, Array]:
        """Centres [k, 3] and radii [k] of spheres around all shapes; infinite around what surrounds the camera."""
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
            normal, place = surface.normal[:, where], points[:, where]
            lit = albedo * self._irradiance(self.light_maps.get((index, face)), place, surface.uv[:, where], normal)
            if material.reflectance and reflect:
                incoming = ray[:, where]
                cosine = -(normal * incoming).sum(0)
                share = material.reflectance + (1 - material.reflectance) * np.clip(1 - cosine, 0, 1) ** 5
                bounced = incoming + 2 * cosine * normal
                mirror = self.color(place + np.float32(1e-3) * normal, bounced, reflect=False)
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
    """Each label that occurs, and where; a slice of everything where it is the only one."""
    low, high = int(labels.min()), int(labels.max())
    if low == high:
        yield low, slice(None)
        return
    for label in np.flatnonzero(np.bincount(labels - low)) + low:
        yield int(label), np.flatnonzero(labels == label)
