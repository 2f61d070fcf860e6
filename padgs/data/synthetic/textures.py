"""Procedural surface textures: seeded functions of the position on a surface, without a resolution.

A texture maps uv [2, n] (metres from the centre of a face, u to the right, v up) to colours [3, n] in [0, 1].
Functions decorated by `texture` are called without uv, and return a texture.
"""

from collections.abc import Callable, Sequence
from functools import cache, wraps
from typing import Any, Concatenate, ParamSpec

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Texture = Callable[[Array], Array]
Color = tuple[float, float, float]
Params = ParamSpec("Params")

_TABLE = 4096


def texture(draw: Callable[Concatenate[Array, Params], Array]) -> Callable[Params, Texture]:
    """Turn a function of uv and parameters into a factory of textures."""

    @wraps(draw)
    def factory(*args: Params.args, **kwargs: Params.kwargs) -> Texture:
        return lambda uv: draw(uv, *args, **kwargs)

    return factory


@cache
def _random_table() -> Array:
    return np.random.default_rng(20_240_601).random(_TABLE, dtype=np.float32)


@cache
def _noise_table(size: int = 512) -> Array:
    """Return a periodic table of 1/f noise in [0, 1]: white noise, filtered in the frequency domain."""
    white = np.fft.rfft2(np.random.default_rng(7).standard_normal((size, size)))
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)) * size
    frequency[0, 0] = 1
    pink = np.fft.irfft2(white / frequency**1.2 * (frequency > 1.5), s=(size, size))
    return np.clip(pink / (5 * pink.std()) + 0.5, 0, 1).astype(np.float32)


@cache
def _glyphs() -> Array:
    glyphs = np.random.default_rng(11).random((32, 7, 5)) < 0.5
    glyphs[:6] = False  # spaces between words
    return glyphs


def bilinear(table: Array, x: Array, y: Array) -> Array:
    """Sample a table [h, w] bilinearly at continuous texel positions; texel (i, j) is at (x, y) = (j, i).

    Tables are periodic if width and height are powers of two; else x and y must be in [0, w - 1) and [0, h - 1).
    """
    height, width = table.shape
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = x - x0, y - y0
    left, top = x0.astype(np.int32), y0.astype(np.int32)
    right, bottom = left + 1, top + 1
    if not (width & (width - 1) or height & (height - 1)):  # bit masks are faster than remainders
        left, right, top, bottom = left & (width - 1), right & (width - 1), top & (height - 1), bottom & (height - 1)
    top *= width
    bottom *= width
    flat = table.ravel()
    upper, lower = flat.take(top + left), flat.take(bottom + left)
    upper += fx * (flat.take(top + right) - upper)
    lower += fx * (flat.take(bottom + right) - lower)
    return upper + fy * (lower - upper)


def noise(u: Array, v: Array, period: float) -> Array:
    """Return 1/f noise in [0, 1] that repeats every `period` metres."""
    table = _noise_table()
    scale = table.shape[0] / period
    return bilinear(table, u * scale, v * scale)


def random_of(*cells: Array | int) -> Array:
    """Return a fixed pseudo-random number in [0, 1) for every combination of integer cells."""
    total = 0
    for cell, prime in zip(cells, (7919, 104_729, 1_299_709), strict=False):
        total = total + np.asarray(cell).astype(np.int32) * np.int32(prime)  # wraps around
    return _random_table().take((total ^ (total >> 7)) & (_TABLE - 1))


def mix(first: Array | Color, second: Array | Color, weight: Array | float) -> Array:
    """Return (1 - weight) first + weight second for colours [3] or [3, n] and weights [n]."""
    a, b = (np.asarray(c, np.float32).reshape(3, -1) for c in (first, second))
    return a + (b - a) * weight


def step(edge: float, x: Array, blur: float) -> Array:
    """Return 0 below `edge`, 1 above, with a linear ramp of width `blur` between."""
    return np.clip((x - edge) / blur + 0.5, 0, 1)


@texture
def plain(uv: Array, color: Color, mottle: float = 0.0, period: float = 1.5) -> Array:
    """Draw one colour, mottled by noise of relative strength `mottle`."""
    tone = 1 + mottle * (2 * noise(uv[0], uv[1], period) - 1) if mottle else np.ones_like(uv[0])
    return np.asarray(color, np.float32)[:, None] * tone


@texture
def planks(uv: Array, dark: Color, light: Color, width: float = 0.14, length: float = 1.3) -> Array:
    """Draw wooden boards along u with grain and dark gaps."""
    row = np.floor(uv[1] / width)
    along = uv[0] / length + random_of(row, 3)
    column = np.floor(along)
    tone = random_of(row, column)
    grain = noise(uv[0] * 0.12 + 3 * tone, uv[1] + 0.7 * tone, 0.8)
    fibre = noise(uv[0] * 0.03 + tone, uv[1], 0.22)
    edge = np.minimum(np.abs(uv[1] / width - row - 0.5), 0.5)
    end = np.abs(along - column - 0.5)
    gap = np.maximum(step(0.478, edge, 0.02), step(0.497, end, 0.003))
    return mix(dark, light, 0.45 * tone + 0.45 * grain + 0.25 * fibre) * (1 - 0.6 * gap)


@texture
def bricks(uv: Array, dark: Color, light: Color, mortar: Color, length: float = 0.25, height: float = 0.085) -> Array:
    """Draw a running bond of bricks."""
    row = np.floor(uv[1] / height)
    along = uv[0] / length + 0.5 * (row % 2)
    column = np.floor(along)
    inside_u = (0.5 - np.abs(along - column - 0.5)) * length
    inside_v = (0.5 - np.abs(uv[1] / height - row - 0.5)) * height
    speckle = noise(uv[0], uv[1], 0.35)
    brick = mix(dark, light, 0.65 * random_of(row, column) + 0.5 * speckle)
    joint = 1 - step(0.007, np.minimum(inside_u, inside_v) + 0.004 * (speckle - 0.5), 0.003)
    return mix(brick, np.asarray(mortar, np.float32)[:, None] * (0.8 + 0.4 * speckle), joint)


@texture
def checker(uv: Array, first: Color, second: Color, size: float = 0.3, mottle: float = 0.25) -> Array:
    """Draw two-coloured square tiles with fine joints and marble-like veins."""
    column, row = np.floor(uv[0] / size), np.floor(uv[1] / size)
    tone = 1 + mottle * (noise(uv[0] + 3 * random_of(row, column), uv[1], 0.9) - 0.5)
    edge = np.maximum(np.abs(uv[0] / size - column - 0.5), np.abs(uv[1] / size - row - 0.5))
    return mix(first, second, (row + column) % 2) * tone * (1 - 0.5 * step(0.488, edge, 0.01))


@texture
def wallpaper(uv: Array, ground: Color, figure: Color, period: float = 0.42) -> Array:
    """Draw a periodic ornament: two families of soft rosettes with fine stripes between."""
    a, b = uv[0] * (2 * np.pi / period), uv[1] * (2 * np.pi / period)
    bloom = np.cos(a) * np.cos(b) + 0.45 * np.cos(2 * a + np.sin(b)) * np.cos(3 * b) + 0.3 * np.cos(4 * a)
    ring = np.abs(bloom - 0.35)
    weight = 0.75 * (1 - step(0.12, ring, 0.08)) + 0.5 * step(0.85, bloom, 0.1)
    stripe = 0.06 * np.cos(uv[0] * (2 * np.pi / 0.03))
    return mix(ground, figure, np.clip(weight, 0, 1)) * (1 + stripe + 0.12 * (noise(uv[0], uv[1], 1.1) - 0.5))


@texture
def stripes(uv: Array, colors: Sequence[Color], width: float = 0.05, mottle: float = 0.1) -> Array:
    """Draw bands across v that cycle through the colours."""
    palette = np.asarray(colors, np.float32)
    band = np.floor(uv[1] / width).astype(np.int64) % len(palette)
    return palette[band].T * (1 + mottle * (noise(uv[0], uv[1], 0.6) - 0.5))


@texture
def print_of(uv: Array, paper: Color, ink: Color, size: float = 0.06) -> Array:
    """Draw lines of random glyphs of 5 x 7 dots, grouped into words."""
    column, line = np.floor(uv[0] / (0.75 * size)), np.floor(uv[1] / (1.6 * size))
    x = ((uv[0] / (0.75 * size) - column) * 6).astype(np.int64)
    y = ((uv[1] / (1.6 * size) - line) * 11).astype(np.int64)
    glyph = (random_of(line, column, 5) * 32).astype(np.int64)
    inside = (x < 5) & (y < 7)
    dot = inside & _glyphs()[glyph, np.minimum(y, 6), np.minimum(x, 4)]
    return mix(paper, ink, dot.astype(np.float32)) * (1 + 0.06 * (noise(uv[0], uv[1], 0.5) - 0.5))


@texture
def books(uv: Array, spines: Sequence[Color], board: Color, shelf: float = 0.32) -> Array:
    """Draw shelves of book spines of different heights and colours, with labels."""
    palette = np.asarray(spines, np.float32)
    level = np.floor(uv[1] / shelf)
    up = (uv[1] / shelf - level) * shelf
    book = np.floor(uv[0] / 0.038 + 7 * random_of(level, 9))
    across = uv[0] / 0.038 + 7 * random_of(level, 9) - book
    top = 0.2 + 0.09 * random_of(level, book, 1)
    color = palette[(random_of(level, book, 2) * len(palette)).astype(np.int64)].T
    label = (np.abs(up - 0.6 * top) < 0.02) & (random_of(level, book, 4) > 0.4)
    round_back = 0.65 + 0.35 * np.sin(np.pi * np.clip(across, 0, 1))
    color = mix(color, (0.9, 0.85, 0.7), np.float32(0.8) * label) * round_back
    color = np.where(up > top, np.float32(0.06), color)
    wood = np.asarray(board, np.float32)[:, None] * (0.8 + 0.4 * noise(uv[0] * 0.2, uv[1], 0.4))
    return np.where(up < 0.03, wood, color)


@texture
def siemens_star(uv: Array, dark: Color, light: Color, spokes: int, pitch: float) -> Array:
    """Draw a lattice of Siemens stars, `pitch` apart, one at the origin."""
    x, y = uv / pitch - np.round(uv / pitch)
    radius = np.hypot(x, y)
    spoke = (np.arctan2(y, x) * (spokes / (2 * np.pi))) % 1 < 0.5
    ring = (np.floor(radius * 60) % 2 == 0) & (radius > 0.46)
    return mix(light, dark, np.where(radius < 0.46, spoke, ring & (radius < 0.5)).astype(np.float32))


@texture
def medallion(uv: Array, ground: Color, figure: Color, accent: Color, radius: float, fold: int) -> Array:
    """Draw a round ornament of `fold`-fold symmetry: a rug on the floor, a rosette on the ceiling."""
    r, angle = np.hypot(uv[0], uv[1]) / radius, np.arctan2(uv[1], uv[0])
    petal = np.cos(fold * angle)
    wave = np.sin(18 * r + 1.4 * petal) * np.cos(2 * fold * angle * np.floor(1 + 2 * r))
    color = mix(ground, figure, step(0.15, wave, 0.25))
    color = mix(color, accent, 1 - step(0.035, np.abs(r - 0.42 - 0.09 * petal), 0.02))
    color = mix(color, accent, step(0.55, np.cos(4 * fold * angle), 0.2) * (np.abs(r - 0.88) < 0.05))
    color = mix(color, figure, (np.abs(r - 0.8) < 0.012) | (np.abs(r - 0.96) < 0.015))
    return color * (1 + 0.25 * (noise(uv[0], uv[1], 0.3) - 0.5))


@texture
def poster(uv: Array, sky: Color, land: Color, sun: Color, size: float) -> Array:
    """Draw a poster: a landscape of layered hills with a sun, over a line of print."""
    caption = print_of((0.93, 0.91, 0.86), (0.15, 0.13, 0.12), size / 14)
    u, v = uv / size
    color = mix(sky, (1, 0.97, 0.9), np.clip(0.5 - 0.9 * v, 0, 1))
    color = mix(color, sun, 1 - step(0.16, np.hypot(u - 0.15, v - 0.18), 0.01))
    for layer in range(3):
        ridge = 0.05 - 0.13 * layer + 0.22 * (noise(u + 1.7 * layer, u * 0 + 0.31 * layer, 2.0) - 0.5)
        color = mix(color, mix(land, sky, 0.55 - 0.25 * layer), step(0, ridge - v, 0.01))
    return np.where(v < -0.36, caption(uv), color)


@texture
def window(uv: Array, glow: Color, frame: Color, panes: int = 2) -> Array:
    """Draw a window seen from inside: bright sky behind a wooden cross."""
    cloud = noise(uv[0], uv[1] * 2, 2.3)
    light = mix(glow, (1, 1, 1), np.clip(1.6 * cloud - 0.4, 0, 1))
    cell = np.abs(uv * panes - np.floor(uv * panes) - 0.5).max(axis=0)
    return mix(light, frame, step(0.45, cell, 0.01))


@texture
def sectors(uv: Array, colors: Sequence[Color], count: int, radius: float) -> Array:
    """Draw beach-ball sectors on a sphere of the given radius (u = longitude x radius, v = latitude x radius)."""
    palette = np.asarray(colors, np.float32)
    sector = np.floor((uv[0] / (2 * np.pi * radius) % 1) * count).astype(np.int64) % len(palette)
    band = np.abs(uv[1] / radius) < 0.12
    cap = np.abs(uv[1] / radius) > 1.25
    return np.where(cap | band, np.float32(0.93), palette[sector].T)


def scaled(texture: Texture, frequency: float) -> Texture:
    """Return the texture with all details `frequency` times finer."""
    return texture if frequency == 1 else lambda uv: texture(uv * frequency)


@texture
def framed(uv: Array, base: Texture, patches: Sequence[tuple[float, float, float, float, Texture]]) -> Array:
    """Draw rectangles (u, v, width, height, texture) with dark borders on top of `base`."""
    color = np.array(base(uv))
    for u, v, width, height, patch in patches:
        local = uv - np.asarray((u, v), uv.dtype)[:, None]
        border = np.maximum(np.abs(local[0]) - width / 2, np.abs(local[1]) - height / 2)
        color[:, border < 0.03] *= 0.15
        inside = np.flatnonzero(border < 0)
        if inside.size:
            color[:, inside] = patch(local[:, inside])
    return color


@texture
def disc(
    uv: Array, base: Texture, patch: Texture, radius: float, centers: Sequence[tuple[float, float]] = ((0, 0),)
) -> Array:
    """Draw `patch` within `radius` of each centre, `base` outside."""
    color = np.empty((3, uv.shape[1]), np.float32)
    outside = np.ones(uv.shape[1], bool)
    for center in centers:
        local = uv - np.asarray(center, uv.dtype)[:, None]
        inside = local[0] * local[0] + local[1] * local[1] < radius * radius
        index = np.flatnonzero(inside)
        if index.size:
            color[:, index] = patch(local[:, index])
            outside &= ~inside
    index = np.flatnonzero(outside)
    if index.size:
        color[:, index] = base(uv[:, index])
    return color
