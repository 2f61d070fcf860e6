"""Tiles per Gaussian: known counts, and latitude bands."""

import math

import pytest
import torch

from padgs.apps.bench.tile_counts import BANDS, BOUNDS, spheres, tiles_by_latitude, tiles_per_gaussian
from padgs.native import cpu

pytestmark = pytest.mark.skipif(not cpu.available(), reason="the native library is not built")
WIDTH, HEIGHT, TILE = 512, 256, 16
MIDDLE = (WIDTH / 2, HEIGHT / 2)


def tiles(column: float, row: float, sigma: float, bounds: str) -> int:
    """Return the tiles of a Gaussian at a point of the image, in pixels."""
    longitude, latitude = (column / WIDTH - 0.5) * 2 * math.pi, (row / HEIGHT - 0.5) * math.pi
    x, y, z = math.cos(latitude) * math.sin(longitude), math.sin(latitude), math.cos(latitude) * math.cos(longitude)
    return int(tiles_per_gaussian(spheres(torch.tensor([[x, y, z]]), sigma, WIDTH), WIDTH, HEIGHT, BOUNDS[bounds]))


@pytest.mark.parametrize("bounds", list(BOUNDS))
def test_small_gaussians_inside_a_tile_on_an_edge_and_on_a_corner(bounds):
    column, row = MIDDLE
    found = [tiles(*at, 1.0, bounds) for at in ((column + 8, row + 8), (column, row + 8), (column, row))]
    assert found == [1, 2, 4]


def test_only_exact_bounds_continue_across_the_seam():
    assert tiles(0.25, HEIGHT / 2 + 8, sigma=1.0, bounds="exact") == 2
    assert tiles(0.25, HEIGHT / 2 + 8, sigma=1.0, bounds="square") == 1


def test_published_bounds_cover_the_whole_image_for_one_gaussian_at_the_pole():
    assert tiles(WIDTH / 2, 0.05, sigma=4.0, bounds="square") == (WIDTH // TILE) * (HEIGHT // TILE)
    assert tiles(WIDTH / 2, 0.05, sigma=4.0, bounds="exact") < 20


def test_bands_add_up_to_the_whole():
    report = tiles_by_latitude(WIDTH, HEIGHT, count=20_000)
    for name in BOUNDS:
        shares = [math.sin(math.radians(high)) - math.sin(math.radians(low)) for low, high in BANDS]
        means = [report[name]["bands"][f"{low}-{high}"]["mean"] for low, high in BANDS]
        whole = sum(share * mean for share, mean in zip(shares, means, strict=True))
        assert whole == pytest.approx(report[name]["mean"], rel=0.1)  # shares of 20 000 random directions
        assert max(band["max"] for band in report[name]["bands"].values()) == report[name]["max"]
    assert report["exact"]["mean"] < report["square"]["mean"]
