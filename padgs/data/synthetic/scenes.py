"""Built-in scenes, as blueprints of one generator.

room, two_rooms (a door between them), outdoor (far ring and sky), pole_torture (Siemens stars and rods at both poles),
bare_room (posters on a tenth of the walls), near_clutter (objects 5-30 cm from the path), glossy (mirror-like
materials, so colours depend on the view), white_room and checker_room (known complexity), room_chain (any number of
rooms in a row).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from padgs.data.synthetic import furniture as fu
from padgs.data.synthetic import textures as tx
from padgs.data.synthetic.options import SyntheticOptions
from padgs.data.synthetic.outdoor import outdoor
from padgs.data.synthetic.paths import Walk
from padgs.data.synthetic.shapes import Box, Material, Rod, Room, Shape
from padgs.data.synthetic.textures import Array, Texture, scaled
from padgs.data.synthetic.world import Light, World

Furnish = Callable[[SyntheticOptions, Array, np.random.Generator], World]  # options, dense path [n, 3], random


@dataclass(frozen=True)
class Blueprint:
    """Recipe of a scene."""

    walk: Walk | Callable[[SyntheticOptions], Walk]
    path: str  # default kind of path
    objects: int  # default number of loose objects
    furnish: Furnish


WHITE: tx.Color = (0.8, 0.8, 0.78)
PAPER: tx.Color = (0.93, 0.91, 0.86)
INK: tx.Color = (0.16, 0.13, 0.12)


def _posters(count: int, width: float, size: float) -> list[tuple[float, float, float, float, Texture]]:
    """Return `count` posters of height `size` in a row along a wall of the given width."""
    looks = (
        tx.poster((0.35, 0.6, 0.85), (0.12, 0.32, 0.22), (0.98, 0.75, 0.25), size),
        tx.print_of(PAPER, INK, size / 16),
        tx.poster((0.9, 0.55, 0.4), (0.25, 0.14, 0.3), (1.0, 0.9, 0.6), size),
        tx.medallion((0.12, 0.18, 0.3), (0.85, 0.7, 0.4), (0.9, 0.9, 0.85), size / 2.2, 7),
    )
    positions = (np.arange(count) + 0.5) / count * width - width / 2
    return [(float(u), 0.15, 0.72 * size, size, looks[k % len(looks)]) for k, u in enumerate(positions)]


def _rug(f: float) -> Texture:
    return scaled(tx.medallion((0.55, 0.13, 0.12), (0.14, 0.17, 0.32), (0.9, 0.76, 0.45), 1.7 * f, 8), f)


def _room_materials(
    options: SyntheticOptions,
    width: float,
    depth: float,
    gloss: float = 0.0,
    rugs: tuple[tuple[float, float], ...] = ((0.0, 0.0),),
) -> tuple[Material, ...]:
    f = options.texture_frequency
    brick = scaled(tx.bricks((0.45, 0.2, 0.14), (0.78, 0.45, 0.33), (0.78, 0.74, 0.68)), f)
    paper = scaled(tx.wallpaper((0.55, 0.62, 0.52), (0.86, 0.83, 0.68)), f)
    tiles = scaled(tx.checker((0.28, 0.42, 0.5), (0.86, 0.87, 0.83), 0.2), f)
    rough = scaled(tx.plain((0.82, 0.79, 0.73), 0.22, 2.0), f)
    rosette = scaled(tx.medallion((0.88, 0.86, 0.8), (0.62, 0.58, 0.5), (0.8, 0.6, 0.25), 1.5 * f, 12), f)
    view = tx.window((0.45, 0.68, 0.95), (0.9, 0.88, 0.83))
    return (
        Material(tx.framed(brick, _posters(2, depth * 0.8, 0.9)[:1])),
        Material(tx.framed(rough, [*_posters(3, depth * 0.85, 0.8)])),
        Material(tx.framed(tiles, ((0.9, 0.25, 1.0, 1.1, view), (-0.9, 0.25, 1.0, 1.1, view)))),
        Material(tx.framed(paper, _posters(3, width * 0.7, 0.75))),
        Material(tx.disc(scaled(tx.planks(*fu.OAK), f), _rug(f), 1.7, rugs), gloss),
        Material(tx.disc(scaled(tx.checker((0.84, 0.82, 0.77), (0.8, 0.78, 0.73), 0.6), f), rosette, 1.5, rugs)),
    )


def _furniture(rng: np.random.Generator) -> list[Shape]:
    """Return the furniture of the 6 x 5 x 2.8 m room, and the rods that cross it."""
    steel = fu.metal()
    return [
        *fu.bookshelf(-1.5, 2.3, 1.6, 2.0),
        *fu.sofa(1.3, 1.95),
        *fu.table(2.35, -1.5, 0.9, 1.2, 0.75),
        fu.loose_object((2.35, -1.3, 0.9), 0.15, rng),
        Box((2.35, -1.75, 0.88), (0.12, 0.17, 0.13), fu.matt(tx.print_of(PAPER, INK, 0.04)), 0.4),
        *fu.crates(-2.45, -1.9, rng),
        *fu.plant(-2.5, 1.3, 1.5, rng),
        *fu.floor_lamp(2.6, 0.7),
        *fu.pendant(0.0, 0.0, 2.8, 0.4),
        Rod((-3, -0.9, 2.35), (3, -0.9, 2.35), 0.015, steel),
        Rod((-3, 0.95, 2.3), (3, 0.95, 2.3), 0.01, steel),
        Rod((-1.9, -2.4, 2.15), (1.9, -2.4, 2.15), 0.02, fu.metal((0.8, 0.65, 0.3))),
        Rod((0.35, -1.75, 0), (0.35, -1.75, 2.8), 0.012, steel),
        Rod((-2.1, 0.1, 0), (-2.1, 0.1, 2.8), 0.015, fu.metal((0.75, 0.3, 0.25))),
    ]


_LOW, _HIGH = (-3.0, -2.5, 0.0), (3.0, 2.5, 2.8)
_LIGHT = Light((((0.0, 0.0, 2.4), 0.85), ((2.6, 0.7, 1.75), 0.35)))


def room(
    options: SyntheticOptions, path: Array, rng: np.random.Generator, gloss: float = 0.0, reflectance: float = 0.0
) -> World:
    """Build a furnished room, 6 x 5 x 2.8 m, with a floor of that gloss and objects of that reflectance."""
    shapes = [Room(_LOW, _HIGH, _room_materials(options, 6, 5, gloss)), *_furniture(rng)]
    shapes += fu.scatter(options.objects or 0, path, (-2.0, -1.8, 0.5), (2.0, 1.5, 2.5), 0.35, rng, reflectance)
    return World(tuple(shapes), _LIGHT)


def near_clutter(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """Build the room with small objects in a layer of 25 cm beside the camera path, by default from 5 cm on."""
    shapes = [Room(_LOW, _HIGH, _room_materials(options, 6, 5)), *_furniture(rng)]
    nearest = 0.05 if options.nearest is None else options.nearest
    return World((*shapes, *fu.beside(options.objects or 0, path, nearest, nearest + 0.25, rng)), _LIGHT)


def bare_room(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """Build a room of smooth surfaces of one colour; posters cover a tenth of the walls."""
    white, gray = tx.plain(WHITE), tx.plain((0.55, 0.55, 0.55))
    # 4 walls are 61.6 m2; 9 posters of 0.72 x 0.975 m cover a tenth.
    rows = ((2, 5), (2, 5), (2, 6), (3, 6))
    walls = [Material(tx.framed(white, _posters(count, extent, 0.975))) for count, extent in rows]
    return _lit_room((*walls, Material(gray), Material(white)), 1.2, options, path, rng)


def pole_torture(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """Build a room with Siemens stars on floor and ceiling, and thin rods around the cameras."""
    f = options.texture_frequency
    star = tx.siemens_star(INK, PAPER, options.spokes, 0.8 / f)
    walls = _room_materials(options, 6, 5)[:4]
    shapes: list[Shape] = [Room(_LOW, _HIGH, (*walls, Material(star), Material(star)))]
    for k, offset in enumerate(np.linspace(-1.2, 1.2, 5)):
        skin = fu.metal(fu.BRIGHT[k])
        shapes += [
            Rod((offset, -2.5, 2.3), (offset, 2.5, 2.3), 0.004 + 0.002 * k, skin),
            Rod((-3, offset, 0.4), (3, offset, 0.4), 0.004 + 0.002 * k, skin),
            Rod((-3, 0.8 * offset, 2.45), (3, 0.8 * offset, 2.45), 0.006, skin),
            Rod((1.7 * offset, 1.9, 0), (1.7 * offset, 1.9, 2.8), 0.01, skin),
            Rod((1.7 * offset, -1.9, 0), (1.7 * offset, -1.9, 2.8), 0.01, skin),
        ]
    shapes += fu.scatter(options.objects or 0, path, (-2.0, -1.8, 0.6), (2.0, 1.8, 2.2), 0.35, rng)
    return World(tuple(shapes), Light((((1.5, 0.0, 2.1), 0.6), ((-1.5, 0.0, 2.1), 0.6)), ambient=(0.5, 0.5, 0.52)))


def two_rooms(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """Build two furnished rooms of 5 x 5 m with an open door between them; most things are hidden from most views."""
    f = options.texture_frequency
    partition = fu.matt(scaled(tx.wallpaper((0.62, 0.5, 0.42), (0.9, 0.82, 0.7)), f))
    shapes: list[Shape] = [
        Room((-5.0, -2.5, 0.0), (5.0, 2.5, 2.8), _room_materials(options, 10, 5, rugs=((-2.6, 0.0), (2.6, 0.0)))),
        *doorway(0, partition),
        *fu.bookshelf(-2.4, 2.3, 1.8, 2.1),
        *fu.table(-3.9, -1.6, 1.2, 0.8, 0.75),
        *fu.crates(-0.6, -2.0, rng),
        *fu.plant(-4.5, 1.9, 1.5, rng),
        *fu.pendant(-2.6, 0.0, 2.8, 0.45),
        *fu.sofa(2.6, 1.95),
        *fu.floor_lamp(4.5, 1.6),
        *fu.table(1.0, -2.0, 0.8, 0.6, 0.6),
        *fu.plant(4.4, -1.9, 1.6, rng),
        *fu.pendant(2.6, 0.0, 2.8, 0.45),
        Rod((0.1, -0.95, 2.3), (5, -0.95, 2.3), 0.012, fu.metal()),
        Rod((-1.2, 1.6, 0), (-1.2, 1.6, 2.8), 0.015, fu.metal()),
    ]
    shapes += fu.scatter(options.objects or 0, path, (-4.3, -1.9, 0.5), (4.3, 1.7, 2.2), 0.35, rng)
    return World(tuple(shapes), Light((((-2.6, 0.0, 2.35), 0.7), ((2.6, 0.0, 2.35), 0.7))))


def checker_room(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """Build a room with white and dark tiles everywhere, `texture_frequency` per metre, and by default no objects."""
    skin = Material(tx.checker(WHITE, (0.25, 0.3, 0.35), 1 / options.texture_frequency, mottle=0.0))
    return _lit_room((skin,) * 6, 2.5, options, path, rng)


def white_room(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """Build a room with white walls, floor and ceiling, and by default no objects."""
    return _lit_room((Material(tx.plain(WHITE)),) * 6, 2.5, options, path, rng)


def _lit_room(
    skins: tuple[Material, ...], high: float, options: SyntheticOptions, path: Array, rng: np.random.Generator
) -> World:
    """Build a room with one lamp and loose objects up to a height."""
    objects = fu.scatter(options.objects or 0, path, (-2.0, -1.8, 0.3), (2.0, 1.5, high), 0.35, rng)
    return World((Room(_LOW, _HIGH, skins), *objects), Light((((0.0, 0.0, 2.5), 0.9),)))


ROOM_LENGTH, WIDTH, HEIGHT = 5.0, 5.0, 2.8  # metres, of a room
ROOMS = 2  # default
ASIDE = 0.9  # metres between the cameras' path and the line of the doors, in the middle of a room
WALLPAPERS: tuple[tuple[tx.Color, tx.Color], ...] = (  # colours of the wallpapers, one pair per room
    ((0.55, 0.62, 0.52), (0.86, 0.83, 0.68)),
    ((0.62, 0.5, 0.42), (0.9, 0.82, 0.7)),
    ((0.42, 0.5, 0.62), (0.84, 0.86, 0.9)),
    ((0.6, 0.42, 0.5), (0.93, 0.82, 0.8)),
    ((0.58, 0.56, 0.36), (0.92, 0.9, 0.72)),
)


def _room_centers(rooms: int) -> list[float]:
    """Return the x coordinates of the rooms' centres; the chain is centred at 0."""
    return [ROOM_LENGTH * (k - (rooms - 1) / 2) for k in range(rooms)]


def room_chain_walk(options: SyntheticOptions) -> Walk:
    """Return a path from end to end and back, on the other side of each room."""
    rooms = options.rooms or ROOMS
    centers = _room_centers(rooms)
    doors = [x + ROOM_LENGTH / 2 for x in centers[:-1]]
    there = [(centers[0] - 1.2, 0.0), (centers[0], ASIDE)]
    for door, x in zip(doors, centers[1:], strict=True):
        there += [(door, 0.0), (x, ASIDE)]
    back = [(centers[-1] + 1.2, 0.0), *((x, -y) for x, y in reversed(there[1:]))]
    center = 0.0 if rooms % 2 else ROOM_LENGTH / 2  # of a cross path: within a room, not in a wall
    return Walk((center, 0.0), (ROOM_LENGTH * rooms / 2 - center - 1.2, ASIDE), waypoints=(*there, *back))


def room_chain(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """Build furnished rooms of 5 x 5 m; a view sees about 1 / rooms of all surfaces."""
    rooms = options.rooms or ROOMS
    f, centers = options.texture_frequency, _room_centers(rooms)
    floor = tx.disc(scaled(tx.planks(*fu.OAK), f), _rug(f), 1.7, [(x, 0.0) for x in centers])
    ceiling = scaled(tx.checker((0.84, 0.82, 0.77), (0.8, 0.78, 0.73), 0.6), f)
    ends = scaled(tx.bricks((0.45, 0.2, 0.14), (0.78, 0.45, 0.33), (0.78, 0.74, 0.68)), f)
    half = ROOM_LENGTH * rooms / 2
    skins = (ends, ends, ends, ends, floor, ceiling)
    shapes: list[Shape] = [
        Room((-half, -WIDTH / 2, 0.0), (half, WIDTH / 2, HEIGHT), tuple(Material(skin) for skin in skins))
    ]
    for k, x in enumerate(centers):
        paper = fu.matt(scaled(tx.wallpaper(*WALLPAPERS[k % len(WALLPAPERS)]), f))
        shapes += [
            Box((x, side * WIDTH / 2, HEIGHT / 2), (ROOM_LENGTH / 2, 0.01, HEIGHT / 2), paper) for side in (-1, 1)
        ]
        shapes += _chain_furniture(k, x, rng)
        if k:
            shapes += doorway(x - ROOM_LENGTH / 2, paper)
    low, high = (-half + 0.7, -1.9, 0.5), (half - 0.7, 1.7, 2.2)
    shapes += fu.scatter((options.objects or 0) * rooms, path, low, high, 0.35, rng)
    return World(tuple(shapes), Light(tuple(((x, 0.0, 2.35), 0.7) for x in centers)))


def doorway(x: float, paper: tuple[Material, ...]) -> list[Shape]:
    """Return a wall at `x` with a framed opening in its middle."""
    frame = fu.matt(tx.planks(*fu.WALNUT, width=0.06))
    return [
        *(Box((x, side * 1.45, 1.4), (0.08, 1.05, 1.4), paper) for side in (-1, 1)),
        Box((x, 0, 2.45), (0.08, 0.4, 0.35), paper),
        *(Box((x, side * 0.4, 1.05), (0.1, 0.03, 1.05), frame) for side in (-1, 1)),
        Box((x, 0, 2.1), (0.1, 0.43, 0.03), frame),
    ]


def _chain_furniture(k: int, x: float, rng: np.random.Generator) -> list[Shape]:
    """Return the furniture of room `k`, centred at `x`."""
    lamp = fu.pendant(x, 0.0, HEIGHT, 0.45)
    if k % 3 == 0:
        return [*lamp, *fu.bookshelf(x - 0.6, 2.3, 1.6, 2.1), *fu.table(x + 0.9, -1.9, 1.2, 0.7, 0.75)]
    if k % 3 == 1:
        return [*lamp, *fu.sofa(x + 0.3, 1.95), *fu.floor_lamp(x + 1.9, 1.7), *fu.plant(x - 1.9, -1.9, 1.5, rng)]
    return [*lamp, *fu.crates(x - 1.5, -2.0, rng), *fu.plant(x + 1.8, 1.9, 1.6, rng), *fu.table(x, 2.0, 1.2, 0.6, 0.6)]


_DOOR_ROUTE = ((0.0, 0.05), (-1.3, 0.3), (-2.4, 1.1), (-3.7, 0.7), (-3.6, -0.6), (-2.2, -1.0), (-1.2, -0.3),
               (0.0, -0.05), (1.3, -0.4), (2.4, -1.1), (3.6, -0.8), (3.7, 0.6), (2.4, 1.0), (1.2, 0.35))  # fmt: skip

BLUEPRINTS: dict[str, Blueprint] = {
    "room": Blueprint(Walk((-0.1, -0.1), (1.4, 1.15)), "roaming", 6, room),
    "two_rooms": Blueprint(Walk((0.0, 0.0), (3.8, 1.1), waypoints=_DOOR_ROUTE), "roaming", 8, two_rooms),
    "outdoor": Blueprint(Walk((0.0, 0.0), (4.0, 3.0), height=1.7), "roaming", 12, outdoor),
    "pole_torture": Blueprint(Walk((0.0, 0.0), (0.9, 0.7), height=1.4), "cross", 4, pole_torture),
    "bare_room": Blueprint(Walk((-0.1, -0.1), (1.4, 1.15)), "roaming", 3, bare_room),
    "near_clutter": Blueprint(Walk((-0.1, -0.1), (1.4, 1.15)), "line", 40, near_clutter),
    "glossy": Blueprint(Walk((-0.1, -0.1), (1.4, 1.15)), "roaming", 8, partial(room, gloss=0.12, reflectance=0.3)),
    "white_room": Blueprint(Walk((-0.1, -0.1), (1.4, 1.15)), "roaming", 0, white_room),
    "checker_room": Blueprint(Walk((-0.1, -0.1), (1.4, 1.15)), "roaming", 0, checker_room),
    "room_chain": Blueprint(room_chain_walk, "roaming", 4, room_chain),
}
