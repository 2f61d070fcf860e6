"""Chain of rooms with open doors in a line: a view sees its own room, and strips of others through the doors."""

from __future__ import annotations

import numpy as np

from padgs.data.synthetic import furniture as fu
from padgs.data.synthetic import textures as tx
from padgs.data.synthetic.options import SyntheticOptions
from padgs.data.synthetic.paths import Walk
from padgs.data.synthetic.shapes import Box, Material, Room, Shape
from padgs.data.synthetic.textures import Array
from padgs.data.synthetic.world import Light, World

LENGTH, WIDTH, HEIGHT = 5.0, 5.0, 2.8  # metres, of a room
ROOMS = 2  # default
ASIDE = 0.9  # metres between the cameras' path and the line of the doors, in the middle of a room
GROUNDS: tuple[tuple[tx.Color, tx.Color], ...] = (  # colours of the wallpapers, one pair per room
    ((0.55, 0.62, 0.52), (0.86, 0.83, 0.68)),
    ((0.62, 0.5, 0.42), (0.9, 0.82, 0.7)),
    ((0.42, 0.5, 0.62), (0.84, 0.86, 0.9)),
    ((0.6, 0.42, 0.5), (0.93, 0.82, 0.8)),
    ((0.58, 0.56, 0.36), (0.92, 0.9, 0.72)),
)


def _centers(rooms: int) -> list[float]:
    """Return the x coordinates of the rooms' centres; the chain is centred at 0."""
    return [LENGTH * (k - (rooms - 1) / 2) for k in range(rooms)]


def walk(options: SyntheticOptions) -> Walk:
    """Return a path from end to end and back, on the other side of each room."""
    rooms = options.rooms or ROOMS
    centers = _centers(rooms)
    doors = [x + LENGTH / 2 for x in centers[:-1]]
    there = [(centers[0] - 1.2, 0.0), (centers[0], ASIDE)]
    for door, x in zip(doors, centers[1:], strict=True):
        there += [(door, 0.0), (x, ASIDE)]
    back = [(centers[-1] + 1.2, 0.0), *((x, -y) for x, y in reversed(there[1:]))]
    center = 0.0 if rooms % 2 else LENGTH / 2  # of a cross path: within a room, not in a wall
    return Walk((center, 0.0), (LENGTH * rooms / 2 - center - 1.2, ASIDE), waypoints=(*there, *back))


def room_chain(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """Build furnished rooms of 5 x 5 m; a view sees about 1 / rooms of all surfaces."""
    rooms = options.rooms or ROOMS
    f, centers = options.texture_frequency, _centers(rooms)
    rug = tx.scaled(tx.medallion((0.55, 0.13, 0.12), (0.14, 0.17, 0.32), (0.9, 0.76, 0.45), 1.7 * f, 8), f)
    floor = tx.disc(tx.scaled(tx.planks(*fu.OAK), f), rug, 1.7, [(x, 0.0) for x in centers])
    ceiling = tx.scaled(tx.checker((0.84, 0.82, 0.77), (0.8, 0.78, 0.73), 0.6), f)
    ends = tx.scaled(tx.bricks((0.45, 0.2, 0.14), (0.78, 0.45, 0.33), (0.78, 0.74, 0.68)), f)
    half = LENGTH * rooms / 2
    skins = (ends, ends, ends, ends, floor, ceiling)
    shapes: list[Shape] = [
        Room((-half, -WIDTH / 2, 0.0), (half, WIDTH / 2, HEIGHT), tuple(Material(skin) for skin in skins))
    ]
    for k, x in enumerate(centers):
        paper = fu.matt(tx.scaled(tx.wallpaper(*GROUNDS[k % len(GROUNDS)]), f))
        shapes += [Box((x, side * WIDTH / 2, HEIGHT / 2), (LENGTH / 2, 0.01, HEIGHT / 2), paper) for side in (-1, 1)]
        shapes += _furniture(k, x, rng)
        if k:
            shapes += doorway(x - LENGTH / 2, paper)
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


def _furniture(k: int, x: float, rng: np.random.Generator) -> list[Shape]:
    """Return the furniture of room `k`, centred at `x`."""
    lamp = fu.pendant(x, 0.0, HEIGHT, 0.45)
    if k % 3 == 0:
        return [*lamp, *fu.bookshelf(x - 0.6, 2.3, 1.6, 2.1), *fu.table(x + 0.9, -1.9, 1.2, 0.7, 0.75)]
    if k % 3 == 1:
        return [*lamp, *fu.sofa(x + 0.3, 1.95), *fu.floor_lamp(x + 1.9, 1.7), *fu.plant(x - 1.9, -1.9, 1.5, rng)]
    return [*lamp, *fu.crates(x - 1.5, -2.0, rng), *fu.plant(x + 1.8, 1.9, 1.6, rng), *fu.table(x, 2.0, 1.2, 0.6, 0.6)]
