"""Shapes by known distances, light maps by known lamps, and textures."""

import numpy as np
import pytest

from padgs.data.synthetic import textures as tx
from padgs.data.synthetic.shapes import Box, Ground, Material, Ring, Rod, Room, Sphere
from padgs.data.synthetic.textures import plain
from padgs.data.synthetic.world import Light, World, lambert, sphere_points

SKIN = (Material(plain((0.5, 0.5, 0.5))),)


def ray(x, y, z):
    direction = np.array([[x], [y], [z]], float)
    return direction / np.linalg.norm(direction)


def at(x, y, z):
    return np.array([[x], [y], [z]], float)


def random_rays(count, origin, dtype=np.float64):
    direction = np.random.default_rng(5).normal(size=(3, count))
    return at(*origin).astype(dtype), (direction / np.linalg.norm(direction, axis=0)).astype(dtype)


@pytest.mark.parametrize(
    ("direction", "distance"),
    [((1, 0, 0), 2.5), ((-1, 0, 0), 3.5), ((0, 1, 0), 2.0), ((0, -1, 0), 3.0), ((0, 0, 1), 1.8), ((0, 0, -1), 1.0)],
)
def test_room_walls_along_the_axes(direction, distance):
    room = Room((-3, -2.5, 0), (3, 2.5, 2.8), SKIN)
    assert room.hit(at(0.5, 0.5, 1.0), ray(*direction))[0] == pytest.approx(distance, abs=1e-12)


def test_known_distances():
    # The sphere's near side is one radius before its centre; so is the rod's; a ray past either misses.
    assert Sphere((0, 5, 0), 2, SKIN).hit(at(0, 0, 0), ray(0, 1, 0))[0] == pytest.approx(3)
    assert Sphere((0, 5, 0), 2, SKIN).hit(at(0, 0, 2.01), ray(0, 1, 0))[0] == np.inf
    assert Sphere((0, -5, 0), 2, SKIN).hit(at(0, 0, 0), ray(0, 1, 0))[0] == np.inf
    rod = Rod((0, 2, -1), (0, 2, 1), 0.25, SKIN)
    assert rod.hit(at(0, 0, 0.5), ray(0, 1, 0))[0] == pytest.approx(1.75)
    assert rod.hit(at(0, 0, 1.1), ray(0, 1, 0))[0] == np.inf
    rounded = Rod((0, 2, -1), (0, 2, 1), 0.25, SKIN, rounded=True)  # 0.15 above the end: 0.2 before the axis
    assert rounded.hit(at(0, 0, 1.15), ray(0, 1, 0))[0] == pytest.approx(1.8)
    # A unit cube turned by 45 degrees shows its edge, sqrt(2) from the centre.
    assert Box((4, 0, 0), (1, 1, 1), SKIN).hit(at(0, 0, 0), ray(1, 0, 0))[0] == pytest.approx(3)
    turned = Box((4, 0, 0), (1, 1, 1), SKIN, yaw=np.pi / 4)
    assert turned.hit(at(0, 0, 0), ray(1, 0, 0))[0] == pytest.approx(4 - np.sqrt(2))
    assert Ground(SKIN).hit(at(0, 0, 3), ray(4, 0, -3))[0] == pytest.approx(5)  # 3-4-5 triangle
    assert Ground(SKIN).hit(at(0, 0, 3), ray(1, 0, 0))[0] == np.inf
    assert Ring(10, 8, SKIN).hit(at(-2, 0, 1), ray(1, 0, 0))[0] == pytest.approx(12)
    assert Ring(10, 8, SKIN).hit(at(0, 0, 9), ray(1, 0, 0))[0] == np.inf


SOLIDS = {
    "sphere": (Sphere((1, 2, 0.5), 1.2, SKIN), lambda p: np.linalg.norm(p - at(1, 2, 0.5), axis=0) - 1.2),
    "box": (
        Box((1, 2, 0.5), (0.5, 0.7, 1.0), SKIN),
        lambda p: np.abs((p - at(1, 2, 0.5)) / at(0.5, 0.7, 1)).max(0) - 1,
    ),
    "rod": (Rod((1, -1, 2), (1, 3, 2), 0.3, SKIN), lambda p: np.hypot(p[0] - 1, p[2] - 2) - 0.3),
    "room": (Room((-3, -3, -2), (3, 4, 3), SKIN), lambda p: np.abs((p - at(0, 0.5, 0.5)) / at(3, 3.5, 2.5)).max(0) - 1),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_hits_lie_on_the_surface_and_face_the_camera(name):
    shape, implicit = SOLIDS[name]
    origin, rays = random_rays(4000, (0, 0, 0))
    t = shape.hit(origin, rays)
    hit = np.isfinite(t)
    assert hit.sum() > 50
    points = origin + t[hit] * rays[:, hit]
    np.testing.assert_allclose(implicit(points), 0, atol=1e-9)
    surface = shape.surface(points)
    np.testing.assert_allclose(np.linalg.norm(surface.normal, axis=0), 1, atol=1e-9)
    assert ((surface.normal * rays[:, hit]).sum(0) < 0).all()
    if shape.bounds is not None:  # a bounding sphere contains the shape
        center, radius = shape.bounds
        assert np.linalg.norm(points - at(*center), axis=0).max() <= radius + 1e-9


def test_single_precision_is_preserved_and_accurate():
    """Check dtypes, because float64 doubles the time, and accuracy on a thin distant rod."""
    thin = Rod((-5, 8, 1), (5, 8, 1), 0.006, SKIN)
    center = np.linspace(0.9, 1.1, 4001)
    rays = np.stack((0 * center, 0 * center + 8, center)) / np.hypot(8, center)
    exact = thin.hit(at(0, 0, 0), rays)
    single = thin.hit(at(0, 0, 0).astype(np.float32), rays.astype(np.float32))
    assert single.dtype == np.float32
    assert (np.isfinite(exact) != np.isfinite(single)).mean() < 2e-3
    for shape, _ in SOLIDS.values():
        origin, rays = random_rays(100, (0, 0, 0), np.float32)
        t = shape.hit(origin, rays)
        surface = shape.surface((origin + np.where(np.isfinite(t), t, 1) * rays).astype(np.float32))
        assert (t.dtype, surface.normal.dtype, surface.uv.dtype) == (np.float32,) * 3


@pytest.mark.parametrize("face", range(6))
def test_point_at_inverts_the_texture_coordinates(face):
    room = Room((-3, -2.5, 0), (3, 2.5, 2.8), SKIN)
    width, height = room.size(face)
    uv = np.random.default_rng(face).uniform(-0.49, 0.49, (2, 50)) * np.array([[width], [height]])
    surface = room.surface(room.point_at(face, uv))
    np.testing.assert_allclose(surface.uv, uv, atol=1e-12)
    assert (surface.face == face).all()


def test_textures_are_not_mirrored():
    """Check that u increases to the right and v upwards, inside a room and outside a box."""
    room, box = Room((-1, -1, -1), (1, 1, 1), SKIN), Box((0, 0, 0), (1, 1, 1), SKIN)
    for forward in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)):
        right = np.cross(forward, (0, 0, 1))
        for shape, place in ((room, np.array(forward)), (box, -np.array(forward))):
            points = np.stack((place, place + 0.1 * right, place + 0.1 * np.array((0, 0, 1))), axis=1).astype(float)
            uv = shape.surface(points).uv
            np.testing.assert_allclose(uv[:, 1] - uv[:, 0], (0.1, 0), atol=1e-12)
            np.testing.assert_allclose(uv[:, 2] - uv[:, 0], (0, 0.1), atol=1e-12)


LIGHT = Light((((0.0, 0.0, 2.0), 1.0),), size=0.1)


def test_unoccluded_light_maps_equal_the_lamp():
    ground = World((Ground(SKIN),), LIGHT).light_maps[0, 0]
    uv = np.array([[0.0, 1.5, -3.0], [0.0, 2.0, 4.0]], np.float32)
    direct, openness = ground.at(uv)
    points = np.concatenate((uv, np.zeros((1, 3), np.float32)))
    up = np.array([[0.0], [0.0], [1.0]], np.float32)
    np.testing.assert_allclose(direct, lambert(points, up, np.array((0, 0, 2.0)), 1.0), atol=5e-3)
    assert direct[0] == pytest.approx(1 / 1.5, abs=5e-3)  # straight below: 1 / (1 + 2 / 4)
    np.testing.assert_allclose(openness, 1, atol=1e-6)


def test_shadows_have_the_right_size_and_soft_edges():
    """Check that a 1 m plate at half the lamp's height casts a 2 m shadow."""
    plate = Box((0, 0, 1.0), (0.5, 0.5, 0.01), SKIN)
    ground = World((Ground(SKIN), plate), LIGHT).light_maps[0, 0]
    across = np.stack((np.linspace(0, 3, 61), np.zeros(61))).astype(np.float32)
    direct, _ = ground.at(across)
    free = World((Ground(SKIN),), LIGHT).light_maps[0, 0].at(across)[0]
    ratio = direct / free
    assert ratio[:14].max() < 0.01  # x < 0.7
    assert ratio[30:].min() > 0.99  # x > 1.5
    assert abs(np.interp(0.5, ratio, across[0]) - 1.0) < 0.1


def test_corners_are_darker_than_the_middle_of_a_floor():
    room = World((Room((-2, -2, 0), (2, 2, 3), SKIN),), LIGHT)
    openness = room.light_maps[0, 4].at(np.array([[0.0, 1.95, 1.95], [0.0, 0.0, 1.95]], np.float32))[1]
    assert openness[0] > 0.95 > openness[1] + 0.2 > openness[2] + 0.3


def test_sphere_points_are_even():
    points = sphere_points(64)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(points.mean(0), 0, atol=0.02)
    np.testing.assert_allclose(points.T @ points / 64, np.eye(3) / 3, atol=0.02)


A, B, C = (0.2, 0.1, 0.1), (0.8, 0.7, 0.6), (0.5, 0.5, 0.2)
TEXTURES = {
    "plain": tx.plain(A, 0.3),
    "planks": tx.planks(A, B),
    "bricks": tx.bricks(A, B, C),
    "checker": tx.checker(A, B),
    "wallpaper": tx.wallpaper(A, B),
    "stripes": tx.stripes((A, B, C)),
    "print_of": tx.print_of(B, A),
    "books": tx.books((A, B, C), C),
    "siemens_star": tx.siemens_star(A, B, 16, 1.0),
    "medallion": tx.medallion(A, B, C, 1.5, 8),
    "poster": tx.poster(A, B, C, 0.8),
    "window": tx.window(A, B),
    "sectors": tx.sectors((A, B), 8, 0.5),
    "framed": tx.framed(tx.plain(A), [(0.2, 0.1, 0.6, 0.8, tx.plain(B))]),
    "disc": tx.disc(tx.plain(A), tx.plain(B), 1.0),
}


@pytest.mark.parametrize("name", TEXTURES)
def test_colours_are_float32_and_in_range(name):
    uv = np.random.default_rng(1).uniform(-3, 3, (2, 5000)).astype(np.float32)
    color = TEXTURES[name](uv)
    assert color.shape == (3, 5000)
    assert color.dtype == np.float32
    assert color.min() >= 0
    assert color.max() < 1.3
    if name != "plain":
        assert color.std() > 0.02  # there is something to see


def test_bilinear_is_exact_at_texels_linear_between_and_periodic():
    table = np.arange(16, dtype=np.float32).reshape(4, 4)
    x, y = np.array([1.0, 1.5, 1.0, 5.0, -1.0]), np.array([2.0, 2.0, 2.5, 2.0, 2.0])
    np.testing.assert_allclose(tx.bilinear(table, x, y), [9, 9.5, 11, 9, 11])
    odd = np.arange(15, dtype=np.float32).reshape(3, 5)  # not periodic: inside only
    np.testing.assert_allclose(tx.bilinear(odd, np.array([3.5]), np.array([1.25])), [9.75])


def test_scaled_textures_have_a_higher_frequency():
    uv = np.random.default_rng(2).uniform(-1, 1, (2, 500)).astype(np.float32)
    texture = TEXTURES["bricks"]
    np.testing.assert_array_equal(tx.scaled(texture, 4.0)(uv), texture(4 * uv))


def test_a_siemens_star_has_the_given_number_of_spokes():
    angle = np.linspace(-np.pi, np.pi, 20_001)[:-1]
    ring = tx.siemens_star((0, 0, 0), (1, 1, 1), 12, 1.0)(0.3 * np.stack((np.cos(angle), np.sin(angle))))[0]
    assert (np.diff(np.append(ring, ring[0])) > 0.5).sum() == 12


def test_framed_patches_have_the_given_position():
    color = TEXTURES["framed"](np.array([[0.2, 0.2, -0.5], [0.1, 0.48, 0.1]], np.float32))
    np.testing.assert_allclose(color[:, 0], B, atol=1e-6)
    np.testing.assert_allclose(color[:, 1], B, atol=1e-6)
    np.testing.assert_allclose(color[:, 2], A, atol=1e-6)
