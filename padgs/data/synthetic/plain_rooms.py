"""Rooms of known complexity: without anything, or with as many loose objects, or as fine checkers, as are asked for."""

from __future__ import annotations

import numpy as np

from padgs.data.synthetic import furniture as fu
from padgs.data.synthetic import textures as tx
from padgs.data.synthetic.light import Light
from padgs.data.synthetic.options import SyntheticOptions
from padgs.data.synthetic.shapes import Material, Room
from padgs.data.synthetic.textures import Array, Texture
from padgs.data.synthetic.world import World

LOW, HIGH = (-3.0, -2.5, 0.0), (3.0, 2.5, 2.8)  # metres, the size of the furnished room
LIGHT = Light((((0.0, 0.0, 2.5), 0.9),))
WHITE: tx.Color = (0.8, 0.8, 0.78)
DARK: tx.Color = (0.25, 0.3, 0.35)
TILE = 1.0  # metres, at `texture_frequency` 1


def white_room(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """White walls, floor and ceiling, and as many objects as are asked for, none by default."""
    return _room(tx.plain(WHITE), options, path, rng)


def checker_room(options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    """The same with two-coloured tiles everywhere, `texture_frequency` of them a metre."""
    tiles = tx.checker(WHITE, DARK, TILE / options.texture_frequency, mottle=0.0)
    return _room(tiles, options, path, rng)


def _room(skin: Texture, options: SyntheticOptions, path: Array, rng: np.random.Generator) -> World:
    objects = fu.scatter(options.objects or 0, path, (-2.0, -1.8, 0.3), (2.0, 1.5, 2.5), 0.35, rng)
    return World((Room(LOW, HIGH, (Material(skin),) * 6), *objects), LIGHT)
