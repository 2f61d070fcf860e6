"""Furniture and loose objects of synthetic scenes, as lists of shapes. Positions in metres, z = 0 is the floor."""

import math

import numpy as np

from padgs.data.capture import DataError
from padgs.data.synthetic import textures as tx
from padgs.data.synthetic.shapes import Box, Material, Point, Rod, Shape, Sphere
from padgs.data.synthetic.textures import Array, Texture

OAK = ((0.42, 0.26, 0.13), (0.78, 0.56, 0.33))
WALNUT = ((0.2, 0.12, 0.07), (0.5, 0.32, 0.18))
BRIGHT = (
    *((0.85, 0.2, 0.16), (0.95, 0.75, 0.2), (0.16, 0.45, 0.75)),
    *((0.2, 0.6, 0.35), (0.9, 0.5, 0.15), (0.55, 0.25, 0.6)),
)
SPINES = (*BRIGHT, (0.3, 0.16, 0.1), (0.1, 0.2, 0.3), (0.75, 0.7, 0.6), (0.15, 0.3, 0.2))


def point(values: Array) -> Point:
    """Convert an array of three numbers to a point."""
    return float(values[0]), float(values[1]), float(values[2])


def matt(texture: Texture, reflectance: float = 0.0) -> tuple[Material, ...]:
    """Return one material for all faces."""
    return (Material(texture, reflectance),)


def metal(color: tx.Color = (0.75, 0.75, 0.78)) -> tuple[Material, ...]:
    """Return the material of rods: plain with fine bands, so that it has texture."""
    darker = (0.8 * color[0], 0.8 * color[1], 0.8 * color[2])
    return matt(tx.stripes((color, color, color, darker), 0.06, 0.0))


def table(x: float, y: float, width: float, depth: float, height: float) -> list[Shape]:
    """Return a wooden table top on four thin legs."""
    shapes: list[Shape] = [Box((x, y, height - 0.02), (width / 2, depth / 2, 0.02), matt(tx.planks(*OAK, width=0.11)))]
    for i, j in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        px, py = x + i * (width / 2 - 0.05), y + j * (depth / 2 - 0.05)
        shapes.append(Rod((px, py, 0), (px, py, height - 0.04), 0.018, metal((0.25, 0.25, 0.27))))
    return shapes


def bookshelf(x: float, y: float, width: float, height: float) -> list[Shape]:
    """Return a shelf full of books."""
    wood = Material(tx.planks(*WALNUT))
    front = Material(tx.books(SPINES, (0.45, 0.3, 0.18)))
    return [Box((x, y, height / 2), (width / 2, 0.15, height / 2), (wood, wood, front, front, wood, wood))]


def sofa(x: float, y: float) -> list[Shape]:
    """Return a sofa with its back towards +y."""
    cloth = matt(tx.wallpaper((0.2, 0.36, 0.4), (0.75, 0.78, 0.68), 0.16))
    pillow = matt(tx.checker((0.85, 0.55, 0.2), (0.95, 0.9, 0.8), 0.08))
    parts = (
        ((0, -0.08, 0.22), (0.9, 0.37, 0.2), cloth),
        ((0, 0.34, 0.45), (0.9, 0.1, 0.43), cloth),
        ((-0.97, 0, 0.3), (0.08, 0.45, 0.3), cloth),
        ((0.97, 0, 0.3), (0.08, 0.45, 0.3), cloth),
        ((-0.55, 0.1, 0.56), (0.2, 0.07, 0.15), pillow),
        ((0.5, 0.1, 0.55), (0.2, 0.07, 0.14), pillow),
    )
    return [Box((x + a, y + b, z), half, skin) for (a, b, z), half, skin in parts]


def floor_lamp(x: float, y: float, height: float = 1.7) -> list[Shape]:
    """Return a thin vertical rod with a glowing globe."""
    globe = Material(tx.stripes(((1, 0.95, 0.8), (0.98, 0.85, 0.6)), 0.04), glows=True)
    return [
        Rod((x, y, 0.02), (x, y, height), 0.012, metal((0.8, 0.65, 0.3))),
        Sphere((x, y, height + 0.11), 0.13, (globe,)),
        Box((x, y, 0.015), (0.15, 0.15, 0.015), matt(tx.plain((0.3, 0.25, 0.15), 0.4))),
    ]


def pendant(x: float, y: float, ceiling: float, drop: float) -> list[Shape]:
    """Return a glowing globe on a thin cord from the ceiling."""
    globe = Material(tx.stripes(((1, 0.98, 0.9), (1, 0.9, 0.7)), 0.05), glows=True)
    cord = Rod((x, y, ceiling - drop + 0.13), (x, y, ceiling), 0.008, metal((0.15, 0.15, 0.15)))
    return [Sphere((x, y, ceiling - drop), 0.14, (globe,)), cord]


def plant(x: float, y: float, height: float, rng: np.random.Generator) -> list[Shape]:
    """Return a pot with thin leaning stems that carry small leaves and blossoms."""
    pot = matt(tx.bricks((0.5, 0.22, 0.14), (0.8, 0.45, 0.3), (0.9, 0.8, 0.7), 0.1, 0.05))
    shapes: list[Shape] = [Box((x, y, 0.2), (0.16, 0.16, 0.2), pot)]
    leaf = matt(tx.plain((0.2, 0.5, 0.2), 0.6, 0.2))
    for k in range(9):
        angle, lean = 2 * math.pi * k / 9 + rng.uniform(-0.2, 0.2), rng.uniform(0.1, 0.35)
        tip = (x + lean * math.cos(angle), y + lean * math.sin(angle), height * rng.uniform(0.7, 1.0))
        shapes.append(Rod((x, y, 0.4), tip, 0.007, matt(tx.plain((0.25, 0.42, 0.16), 0.5, 0.3))))
        bloom = matt(tx.plain(BRIGHT[k % 2], 0.4, 0.1)) if k % 3 == 0 else leaf
        shapes.append(Sphere(tip, rng.uniform(0.04, 0.07), bloom))
    return shapes


def person(x: float, y: float, heading: float) -> list[Shape]:
    """Return a person of 1.75 m in mid-stride."""
    ahead = np.array((math.cos(heading), math.sin(heading), 0.0))
    left, foot = np.array((-ahead[1], ahead[0], 0.0)), np.array((x, y, 0.0))
    cloth, shirt = (matt(tx.stripes(colors, 0.03)) for colors in (((0.1, 0.14, 0.3), (0.16, 0.2, 0.4)), BRIGHT[:2]))
    skin = matt(tx.plain((0.8, 0.58, 0.45), 0.2, 0.3))

    def limb(start: Array, end: Array, radius: float, material: tuple[Material, ...]) -> Rod:
        return Rod(point(foot + start), point(foot + end), radius, material, rounded=True)

    up = np.array((0.0, 0.0, 1.0))
    shapes: list[Shape] = [limb(0.95 * up, 1.35 * up, 0.17, shirt), Sphere(point(foot + 1.63 * up), 0.12, skin)]
    for side in (1, -1):
        shapes.append(limb(0.1 * side * left + 0.9 * up, side * (0.1 * left + 0.28 * ahead) + 0.06 * up, 0.07, cloth))
        hand = side * (0.26 * left - 0.25 * ahead) + 0.9 * up
        shapes.append(limb(0.22 * side * left + 1.4 * up, hand, 0.045, skin))
    return shapes


def crates(x: float, y: float, rng: np.random.Generator) -> list[Shape]:
    """Return a stack of printed wooden crates."""
    shapes: list[Shape] = []
    z = 0.0
    for half in (0.3, 0.24, 0.17):
        label = tx.print_of((0.9, 0.86, 0.75), (0.2, 0.12, 0.08), half / 4)
        skin = tx.framed(tx.planks(*OAK, width=half / 3), ((0.0, 0.0, half, 0.7 * half, label),))
        shapes.append(Box((x, y, z + 0.8 * half), (half, half, 0.8 * half), matt(skin), rng.uniform(-0.6, 0.6)))
        z += 1.6 * half
    return shapes


def loose_object(where: Point, size: float, rng: np.random.Generator, reflectance: float = 0.0) -> Shape:
    """Return a random ball, box or bar of the given radius about a point."""
    first, second = (BRIGHT[i] for i in rng.choice(len(BRIGHT), 2, replace=False))
    pale = (0.93, 0.9, 0.84)
    kind = rng.integers(4)
    if kind == 0:
        return Sphere(where, size, matt(tx.sectors((first, pale, second, pale), 8, size), reflectance))
    if kind == 1:
        half = point(size / math.sqrt(3) * rng.uniform(0.7, 1.0, 3))
        pattern = tx.checker(first, pale, size / 3) if rng.random() < 0.5 else tx.print_of(pale, first, size / 5)
        return Box(where, half, matt(pattern, reflectance), rng.uniform(0, math.pi))
    if kind == 2:
        return Sphere(where, size, matt(tx.stripes((first, second, pale), size / 4), reflectance))
    tilt = rng.normal(size=3) * (1, 1, 0.6)
    half = size * tilt / np.linalg.norm(tilt)
    ends = point(np.subtract(where, half)), point(np.add(where, half))
    return Rod(ends[0], ends[1], size / 6, matt(tx.stripes((first, pale), size / 5), reflectance), rounded=True)


def scatter(
    count: int, path: Array, low: Point, high: Point, clearance: float, rng: np.random.Generator, reflectance: float = 0
) -> list[Shape]:
    """Place loose objects in a box, apart from each other and from the camera path; low ones stand on thin rods."""
    shapes: list[Shape] = []
    positions, sizes = np.empty((0, 3)), np.empty(0)
    for _ in range(count):
        size = rng.uniform(0.07, 0.16)
        for _attempt in range(200):
            where = rng.uniform(low, high)
            apart = (np.linalg.norm(positions - where, axis=1) > sizes + size).all()
            if apart and _distance(path, where) > clearance + size:
                break
        else:
            raise DataError(f"no free position for object {len(sizes) + 1} of {count}; lower data.generator.objects")
        positions, sizes = np.vstack((positions, where)), np.append(sizes, size)
        shapes.append(loose_object(point(where), size, rng, reflectance))
        x, y, z = point(where)
        if z < high[2] * 0.6:  # supports of higher objects would block the cameras
            shapes.append(Rod((x, y, 0), (x, y, z), 0.01, metal()))
    return shapes


def beside(count: int, path: Array, nearest: float, farthest: float, rng: np.random.Generator) -> list[Shape]:
    """Place small objects with surfaces `nearest` to `farthest` metres from the camera path."""
    shapes: list[Shape] = []
    for _attempt in range(200 * count + 1):
        if len(shapes) == count:
            return shapes
        size = rng.uniform(0.02, 0.07)
        direction = rng.normal(size=3) * (1, 1, 0.7)
        gap = rng.uniform(nearest, farthest)
        where = path[rng.integers(len(path))] + direction / np.linalg.norm(direction) * (gap + size)
        if _distance(path, where) >= nearest + size:
            shapes.append(loose_object(point(where), size, rng))
    raise DataError(f"no free positions for {count} objects beside the path; lower data.generator.objects")


def _distance(path: Array, where: Array) -> float:
    return float(np.linalg.norm(path - where, axis=1).min())
