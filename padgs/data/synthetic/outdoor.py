"""Outdoor scene: ground, houses and street furniture, a ring of mountains (by default at 300 m), and a sky.

The range of depths is 1 : 1000.
"""

from __future__ import annotations

import math

import numpy as np

from padgs.data.synthetic import furniture as fu
from padgs.data.synthetic import textures as tx
from padgs.data.synthetic.options import SyntheticOptions
from padgs.data.synthetic.shapes import Box, Ground, Material, Ring, Rod, Shape
from padgs.data.synthetic.textures import Array, Texture, scaled
from padgs.data.synthetic.world import Light, World


def sky(direction: Array) -> Array:
    """Return the colours [3, n] of a blue gradient with clouds on a flat layer overhead."""
    up = np.maximum(direction[2], 0)
    color = tx.mix((0.86, 0.9, 0.94), (0.3, 0.52, 0.85), np.sqrt(up))
    reach = 1 / (up + 0.12)
    cloud = tx.noise(direction[0] * reach, direction[1] * reach, 5.0)
    return tx.mix(color, (0.98, 0.98, 0.97), np.clip(2.6 * cloud - 1.15, 0, 1) * np.clip(6 * up, 0, 1)).astype(
        np.float32
    )


def _meadow(frequency: float) -> Texture:
    paving = scaled(tx.checker((0.6, 0.57, 0.52), (0.68, 0.65, 0.6), 0.5), frequency)
    star = tx.medallion((0.7, 0.66, 0.58), (0.45, 0.25, 0.2), (0.25, 0.3, 0.38), 2.2, 9)

    def grass(uv: Array) -> Array:
        far, near = tx.noise(uv[0], uv[1], 37.0), tx.noise(uv[0], uv[1], 0.9 / frequency)
        color = tx.mix((0.2, 0.36, 0.12), (0.52, 0.56, 0.25), 0.6 * far + 0.5 * near)
        furrow = 0.5 + 0.5 * np.sin(uv[0] * 0.35 + 6 * far)
        return tx.mix(color, (0.45, 0.36, 0.22), 0.25 * furrow)

    return tx.disc(grass, tx.disc(paving, star, 2.2), 7.5)


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
    f = options.texture_frequency
    walls = (
        tx.bricks((0.5, 0.24, 0.18), (0.8, 0.5, 0.38), (0.8, 0.77, 0.7), 0.4, 0.13),
        tx.plain((0.86, 0.78, 0.6), 0.3, 3.0),
        tx.bricks((0.55, 0.53, 0.5), (0.75, 0.73, 0.7), (0.5, 0.48, 0.45), 0.9, 0.4),
        tx.stripes(((0.62, 0.7, 0.74), (0.7, 0.77, 0.8)), 0.25, 0.3),
    )
    roof = Material(scaled(tx.bricks((0.4, 0.15, 0.1), (0.6, 0.28, 0.2), (0.25, 0.12, 0.1), 0.35, 0.3), f))
    horizon = 300.0 if options.horizon is None else options.horizon
    magnification = horizon / 300
    shapes: list[Shape] = [
        Ground((Material(_meadow(f)),)),
        Ring(horizon, 60 * magnification, (Material(scaled(_mountains, 1 / magnification), glows=True),)),
    ]
    for k in range(14):
        far = 11 + 5.5 * k * rng.uniform(0.8, 1.2)
        angle = 2.4 * k + rng.uniform(-0.3, 0.3)
        half = rng.uniform((2.5, 2.5, 2.5), (4.5, 4.0, 6.0))
        x, y, yaw = far * math.cos(angle), far * math.sin(angle), float(rng.uniform(-0.5, 0.5))
        if far > 0.8 * horizon:  # in the mountains or behind them
            continue
        side = [Material(_facade(scaled(walls[k % 4], f), 2 * half[axis], 2 * half[2])) for axis in (1, 1, 0, 0)]
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
