"""Textures: range, precision, periodicity and frequency."""

import numpy as np
import pytest

from padgs.data.synthetic import textures as tx

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
