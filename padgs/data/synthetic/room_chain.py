"""A row of rooms with open doors on one line: a view sees its own room, and through the doors strips of others."""

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
ROOMS = 2  # unless asked otherwise
ASIDE = 0.9  # metres from the line of the doors at which the cameras pass through a room
GROUNDS: tuple[tuple[tx.Color, tx.Color], ...] = (  # of the wallpapers, a pair a room
    ((0.55, 0.62, 0.52), (0.86, 0.83, 0.68)),
    ((0.62, 0.5, 0.42), (0.9, 0.82, 0.7)),
    ((0.42, 0.5, 0.62), (0.84, 0.86, 0.9)),
    ((0.6, 0.42, 0.5), (0.93, 0.82, 0.8)),
    ((0.58, 0.56, 0.36), (0.92, 0.9, 0.72)),
)


def _middles(rooms: int) -> list[float]:
    """Where along x the rooms have their middles; the row's own is at 0."""
    return [LENGTH * (k - (rooms - 1) / 2) for k in range(rooms)]


def walk(options: SyntheticOptions) -> Walk:
    """From end to end and back, on the other side of each room."""
    rooms = options.rooms or ROOMS
    middles = _middles(rooms)
    doors = [x + LENGTH / 2 for x in middles[:-1]]
    there = [(middles[0] - 1.2, 0.0), (middles[0], ASIDE)]
    for door, x in zip(doors, middles[1:], strict=True):
        there += [(door, 0.0), (x, ASIDE)]
    back = [(middles[-1] + 1.2, 0.0), *((x, -y) for x, y in reversed(there[1:]))]
    center = 0.0 if rooms % 2 else LENGTH / 2  # of a cross: in a room, not in the wall between two
    return Walk((center, 0.0), (LENGTH * rooms / 2 - center - 1.2, ASIDE), waypoints=(*there, *back))


def enfilade(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """Furnished rooms of 5 x 5 m; but for what the doors show, 1 - 1 / rooms of all is hidden from a view."""
    rooms = options.rooms or ROOMS
    f, middles = options.texture_frequency, _middles(rooms)
    rug = tx.scaled(tx.medallion((0.55, 0.13, 0.12), (0.14, 0.17, 0.32), (0.9, 0.76, 0.45), 1.7 * f, 8), f)
    floor = tx.disc(tx.scaled(tx.planks(*fu.OAK), f), rug, 1.7, [(x, 0.0) for x in middles])
    ceiling = tx.scaled(tx.checker((0.84, 0.82, 0.77), (0.8, 0.78, 0.73), 0.6), f)
    ends = tx.scaled(tx.bricks((0.45, 0.2, 0.14), (0.78, 0.45, 0.33), (0.78, 0.74, 0.68)), f)
    half = LENGTH * rooms / 2
    skins = (ends, ends, ends, ends, floor, ceiling)
    shapes: list[Shape] = [
        Room((-half, -WIDTH / 2, 0.0), (half, WIDTH / 2, HEIGHT), tuple(Material(skin) for skin in skins))
    ]
    for k, x in enumerate(middles):
        paper = fu.matt(tx.scaled(tx.wallpaper(*GROUNDS[k % len(GROUNDS)]), f))
        shapes += [Box((x, side * WIDTH / 2, HEIGHT / 2), (LENGTH / 2, 0.01, HEIGHT / 2), paper) for side in (-1, 1)]
        shapes += _furniture(k, x, rng)
        if k:
            shapes += doorway(x - LENGTH / 2, paper)
    low, high = (-half + 0.7, -1.9, 0.5), (half - 0.7, 1.7, 2.2)
    shapes += fu.scatter((options.objects or 0) * rooms, path, low, high, 0.35, rng)
    return World(tuple(shapes), Light(tuple(((x, 0.0, 2.35), 0.7) for x in middles)))


def doorway(x: float, paper: tuple[Material, ...]) -> list[Shape]:
    """A wall across at `x`, of the width and height of a room, and the frame of the opening in its middle."""
    frame = fu.matt(tx.planks(*fu.WALNUT, width=0.06))
    return [
        *(Box((x, side * 1.45, 1.4), (0.08, 1.05, 1.4), paper) for side in (-1, 1)),
        Box((x, 0, 2.45), (0.08, 0.4, 0.35), paper),
        *(Box((x, side * 0.4, 1.05), (0.1, 0.03, 1.05), frame) for side in (-1, 1)),
        Box((x, 0, 2.1), (0.1, 0.43, 0.03), frame),
    ]


def _furniture(k: int, x: float, rng: np.random.Generator) -> list[Shape]:
    """What stands along the walls of room `k`, whose middle is at `x`."""
    lamp = fu.pendant(x, 0.0, HEIGHT, 0.45)
    if k % 3 == 0:
        return [*lamp, *fu.bookshelf(x - 0.6, 2.3, 1.6, 2.1), *fu.table(x + 0.9, -1.9, 1.2, 0.7, 0.75)]
    if k % 3 == 1:
        return [*lamp, *fu.sofa(x + 0.3, 1.95), *fu.floor_lamp(x + 1.9, 1.7), *fu.plant(x - 1.9, -1.9, 1.5, rng)]
    return [*lamp, *fu.crates(x - 1.5, -2.0, rng), *fu.plant(x + 1.8, 1.9, 1.6, rng), *fu.table(x, 2.0, 1.2, 0.6, 0.6)]
