"""Built-in scenes: worlds of shapes from the descriptions in scenes.yaml.

`outdoor` and `room_chain` (any number of rooms in a row) are described in Python.
"""

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from padgs.data.synthetic import furniture as fu
from padgs.data.synthetic import textures as tx
from padgs.data.synthetic.options import SyntheticOptions
from padgs.data.synthetic.paths import Walk
from padgs.data.synthetic.shapes import Box, Ground, Material, Ring, Rod, Room, Shape, Sphere
from padgs.data.synthetic.textures import Array, Texture, scaled
from padgs.data.synthetic.world import Light, World

ROOM_LENGTH, WIDTH, HEIGHT = 5.0, 5.0, 2.8  # metres, of a room of a chain
ROOMS = 2  # default
ASIDE = 0.9  # metres between the cameras' path and the line of the doors, in the middle of a room
CLEARANCE = 0.35  # metres between loose objects and the cameras' path


@cache
def descriptions() -> dict[str, Any]:
    """Return the content of scenes.yaml."""
    return yaml.safe_load(Path(__file__).with_name("scenes.yaml").read_text(encoding="utf-8"))


class Builder:
    """Evaluates descriptions; `x` is the position of a room's centre."""

    def __init__(self, options: SyntheticOptions, rng: np.random.Generator, x: float = 0.0) -> None:
        f = options.texture_frequency
        self.functions: dict[str, Callable[..., Any]] = {
            "detailed": lambda texture: scaled(texture, f),
            "per_detail": lambda length: length * f,
            "by_detail": lambda length: length / f,
            "spokes": lambda: options.spokes,
            "posters": self.posters,
            "pole_rods": pole_rods,
            "matt": fu.matt,
            "metal": fu.metal,
            "box": Box,
            "rod": Rod,
            "sphere": Sphere,
            "loose_object": lambda where, size: [fu.loose_object(where, size, rng)],
            "crates": lambda dx, y: fu.crates(x + dx, y, rng),
            "plant": lambda dx, y, height: fu.plant(x + dx, y, height, rng),
        }
        furniture: list[Callable[..., Any]] = [fu.table, fu.bookshelf, fu.sofa, fu.floor_lamp, fu.pendant]
        for make in furniture:
            self.functions[make.__name__] = lambda dx, *values, make=make: make(x + dx, *values)

    def __call__(self, description: Any) -> Any:
        """Return a texture, a shape or another value."""
        if isinstance(description, str):
            return self(descriptions()["textures"][description])
        if not isinstance(description, list):
            return description
        if not (description and isinstance(description[0], str) and description[0] not in descriptions()["textures"]):
            return tuple(map(self, description))
        function = self.functions.get(description[0]) or getattr(tx, description[0])
        return function(*map(self, description[1:]))

    def shapes(self, description: list[Any]) -> list[Shape]:
        """Return the shapes of a list of shapes and pieces of furniture."""
        made = map(self, description)
        return [shape for part in made for shape in (part if isinstance(part, list) else [part])]

    def posters(self, count: int, width: float, size: float, shown: int | None = None) -> list[Any]:
        """Return the first of `count` posters of height `size` in a row along a wall of the given width."""
        self.functions["height"] = lambda part: size / part
        looks = [self(picture) for picture in descriptions()["pictures"]]
        positions = (np.arange(count) + 0.5) / count * width - width / 2
        row = [(float(u), 0.15, 0.72 * size, size, looks[k % len(looks)]) for k, u in enumerate(positions)]
        return row[:shown]


def world(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """Build the world of a scene around the dense path [n, 3] of its cameras."""
    if options.scene in ("outdoor", "room_chain"):
        return (outdoor if options.scene == "outdoor" else room_chain)(options, path, rng)
    of, build, count = descriptions()["scenes"][options.scene], Builder(options, rng), options.objects or 0
    skins = [Material(build(face)) for face in of["faces"]]
    skins[4] = Material(skins[4].texture, of.get("gloss", 0.0))
    shapes = [Room((-3.0, -2.5, 0.0), (3.0, 2.5, 2.8), tuple(skins)), *build.shapes(of.get("shapes", []))]
    if of["scatter"] is None:
        nearest = 0.05 if options.nearest is None else options.nearest
        shapes += fu.beside(count, path, nearest, nearest + 0.25, rng)
    else:
        low, high = build(of["scatter"])
        shapes += fu.scatter(count, path, low, high, CLEARANCE, rng, of.get("reflectance", 0.0))
    return World(tuple(shapes), Light(build(of["lamps"]), ambient=of.get("ambient", Light.ambient)))


def pole_rods() -> list[Shape]:
    """Return thin rods above, below and around the cameras."""
    shapes: list[Shape] = []
    for k, offset in enumerate(np.linspace(-1.2, 1.2, 5)):
        skin = fu.metal(fu.BRIGHT[k])
        shapes += [
            Rod((offset, -2.5, 2.3), (offset, 2.5, 2.3), 0.004 + 0.002 * k, skin),
            Rod((-3, offset, 0.4), (3, offset, 0.4), 0.004 + 0.002 * k, skin),
            Rod((-3, 0.8 * offset, 2.45), (3, 0.8 * offset, 2.45), 0.006, skin),
            *(Rod((1.7 * offset, y, 0), (1.7 * offset, y, 2.8), 0.01, skin) for y in (1.9, -1.9)),
        ]
    return shapes


def walk(options: SyntheticOptions) -> Walk:
    """Return the free space of a scene's cameras; in a chain of rooms, a route from end to end and back."""
    if options.scene != "room_chain":
        return Walk(**descriptions()["scenes"][options.scene]["walk"])
    centers = _room_centers(options)
    there = [(centers[0] - 1.2, 0.0), (centers[0], ASIDE)]
    for x in centers[1:]:
        there += [(x - ROOM_LENGTH / 2, 0.0), (x, ASIDE)]
    back = [(centers[-1] + 1.2, 0.0), *((x, -y) for x, y in reversed(there[1:]))]  # on the other side of each room
    center = 0.0 if len(centers) % 2 else ROOM_LENGTH / 2  # of a cross path: within a room, not in a wall
    return Walk((center, 0.0), (ROOM_LENGTH * len(centers) / 2 - center - 1.2, ASIDE), waypoints=(*there, *back))


def _room_centers(options: SyntheticOptions) -> list[float]:
    """Return the x coordinates of the rooms' centres; the chain is centred at 0."""
    rooms = options.rooms or ROOMS
    return [ROOM_LENGTH * (k - (rooms - 1) / 2) for k in range(rooms)]


def room_chain(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """Build furnished rooms of 5 x 5 m; a view sees about 1 / rooms of all surfaces."""
    centers, build, described = _room_centers(options), Builder(options, rng), descriptions()["chain"]
    floor = tx.disc(build("boards"), build("rug"), 1.7, [(x, 0.0) for x in centers])
    skins = tuple(map(Material, (*[build("brick")] * 4, floor, build("squares"))))
    half = ROOM_LENGTH * len(centers) / 2
    shapes: list[Shape] = [Room((-half, -WIDTH / 2, 0.0), (half, WIDTH / 2, HEIGHT), skins)]
    for k, x in enumerate(centers):
        paper = fu.matt(build(["detailed", described["papers"][k % 5]]))
        half_wall = (ROOM_LENGTH / 2, 0.01, HEIGHT / 2)
        shapes += [Box((x, side * WIDTH / 2, HEIGHT / 2), half_wall, paper) for side in (-1, 1)]
        furniture = described["furniture"][k % 3]
        shapes += Builder(options, rng, x).shapes([["pendant", 0.0, 0.0, HEIGHT, 0.45], *furniture])
        if k:
            shapes += _doorway(x - ROOM_LENGTH / 2, paper)
    low, high = (-half + 0.7, -1.9, 0.5), (half - 0.7, 1.7, 2.2)
    shapes += fu.scatter((options.objects or 0) * len(centers), path, low, high, CLEARANCE, rng)
    return World(tuple(shapes), Light(tuple(((x, 0.0, 2.35), 0.7) for x in centers)))


def _doorway(x: float, paper: tuple[Material, ...]) -> list[Shape]:
    """Return a wall at `x` with a framed opening in its middle."""
    frame = fu.matt(tx.planks(*fu.WALNUT, width=0.06))
    return [
        *(Box((x, side * 1.45, 1.4), (0.08, 1.05, 1.4), paper) for side in (-1, 1)),
        Box((x, 0, 2.45), (0.08, 0.4, 0.35), paper),
        *(Box((x, side * 0.4, 1.05), (0.1, 0.03, 1.05), frame) for side in (-1, 1)),
        Box((x, 0, 2.1), (0.1, 0.43, 0.03), frame),
    ]


def sky(direction: Array) -> Array:
    """Return the colours [3, n] of a blue gradient with clouds on a flat layer overhead."""
    up = np.maximum(direction[2], 0)
    color = tx.mix((0.86, 0.9, 0.94), (0.3, 0.52, 0.85), np.sqrt(up))
    reach = 1 / (up + 0.12)
    cloud = tx.noise(direction[0] * reach, direction[1] * reach, 5.0)
    share = np.clip(2.6 * cloud - 1.15, 0, 1) * np.clip(6 * up, 0, 1)
    return tx.mix(color, (0.98, 0.98, 0.97), share).astype(np.float32)


def _meadow(build: Builder) -> Texture:
    """Return grass around a paved circle."""
    blade = build(["by_detail", 0.9])

    def grass(uv: Array) -> Array:
        far, near = tx.noise(uv[0], uv[1], 37.0), tx.noise(uv[0], uv[1], blade)
        color = tx.mix((0.2, 0.36, 0.12), (0.52, 0.56, 0.25), 0.6 * far + 0.5 * near)
        furrow = 0.5 + 0.5 * np.sin(uv[0] * 0.35 + 6 * far)
        return tx.mix(color, (0.45, 0.36, 0.22), 0.25 * furrow)

    return tx.disc(grass, build(["disc", "paving", "compass", 2.2]), 7.5)


def _mountains(uv: Array) -> Array:
    """Draw the mountains for a distance of 300 m."""
    rock = tx.noise(uv[0], uv[1] * 2, 260.0)
    height = uv[1] / 45 + 0.35 * (rock - 0.5)
    color = tx.mix((0.32, 0.42, 0.38), (0.5, 0.54, 0.62), tx.step(0.45, height, 0.3))
    color = tx.mix(color, (0.93, 0.94, 0.97), tx.step(0.85, height, 0.12))
    return tx.mix(color, (0.75, 0.81, 0.88), 0.35) * (0.75 + 0.5 * rock)


def _facade(wall: Texture, width: float, height: float) -> Texture:
    glass = tx.window((0.3, 0.4, 0.52), (0.9, 0.88, 0.84), 2)
    patches = [
        (float(u), float(v), 0.9, 1.2, glass)
        for u in np.arange(-width / 2 + 1.2, width / 2 - 0.9, 2.1)
        for v in np.arange(-height / 2 + 1.6, height / 2 - 0.8, 2.4)
    ]
    return tx.framed(wall, patches)


def outdoor(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """Build the scene; loose objects are at least 0.3 m from the path and at most 6 m from the centre."""
    build = Builder(options, rng)
    walls = [build(f"house_{k}") for k in range(4)]
    roof = Material(build("roof"))
    horizon = 300.0 if options.horizon is None else options.horizon
    magnification = horizon / 300
    mountains = Material(scaled(_mountains, 1 / magnification), glows=True)
    shapes: list[Shape] = [Ground((Material(_meadow(build)),)), Ring(horizon, 60 * magnification, (mountains,))]
    for k in range(14):
        far = 11 + 5.5 * k * rng.uniform(0.8, 1.2)
        angle = 2.4 * k + rng.uniform(-0.3, 0.3)
        half = rng.uniform((2.5, 2.5, 2.5), (4.5, 4.0, 6.0))
        x, y, yaw = far * math.cos(angle), far * math.sin(angle), float(rng.uniform(-0.5, 0.5))
        if far > 0.8 * horizon:  # in the mountains or behind them
            continue
        side = [Material(_facade(walls[k % 4], 2 * half[axis], 2 * half[2])) for axis in (1, 1, 0, 0)]
        shapes.append(Box((x, y, half[2]), fu.point(half), (*side, roof, roof), yaw))
        shapes.append(Box((x, y, 2 * half[2] + 0.15), (half[0] + 0.3, half[1] + 0.3, 0.15), (roof,), yaw))
    for k in range(8):
        angle = math.pi / 4 * k + 0.2
        x, y = 6.5 * math.cos(angle), 6.5 * math.sin(angle)
        shapes.append(Rod((x, y, 0), (x, y, 4.5), 0.04, fu.metal((0.3, 0.33, 0.35))))
        shapes += fu.floor_lamp(0.7 * x, 0.7 * y, 1.1) if k % 2 else fu.plant(0.8 * x, 0.8 * y, 1.6, rng)
        next_angle = angle + math.pi / 4
        end = (6.5 * math.cos(next_angle), 6.5 * math.sin(next_angle), 4.4)
        shapes.append(Rod((x, y, 4.4), end, 0.015, fu.metal((0.2, 0.2, 0.2))))
    shapes += fu.scatter(options.objects or 0, path, (-5.0, -4.0, 0.3), (5.0, 4.0, 1.6), 0.3, rng)
    sun = ((260.0, 180.0, 330.0), 90.0)  # nearly parallel light
    return World(tuple(shapes), Light((sun,), ambient=(0.45, 0.5, 0.58), size=4.0), sky)
