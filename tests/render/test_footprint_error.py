"""Errors of footprints against the ray response: known numbers, laws, and the table in the docs."""

import re
from pathlib import Path

import pytest
from support.footprint_error import LATITUDES, REFERENCE, SIGMAS, footprint_error

PAGE = Path(__file__).resolve().parents[2] / "docs" / "notes" / "projection_error.md"


@pytest.mark.parametrize("latitude", [0.0, 60.0, -89.0])
def test_ray_has_no_error(latitude: float):
    for sigma in (2.0, 10.0):
        assert footprint_error("ray", sigma, latitude) < 1e-9


def test_tangent_error_does_not_depend_on_latitude():
    errors = [footprint_error("tangent", 5.0, latitude) for latitude in (0.0, 45.0, 89.0, -70.0)]
    assert errors == pytest.approx([errors[0]] * 4, rel=5e-3)
    # q = tan^2 instead of sin^2: the relative loss is of order sigma^2.
    ratio = footprint_error("tangent", 4.0, 0.0) / footprint_error("tangent", 2.0, 0.0)
    assert ratio == pytest.approx(4, rel=0.1)


def test_erp_error_is_symmetric():
    for latitude in (30.0, 85.0):
        assert footprint_error("erp", 4.0, latitude) == pytest.approx(footprint_error("erp", 4.0, -latitude), rel=1e-9)


def test_cubemap_error_is_the_same_on_all_faces():
    """The front face from centre to edge mirrors the lower face from edge to centre."""
    for latitude in (10.0, 30.0):
        above, below = (footprint_error("cubemap", 2.0, angle) for angle in (latitude, 90 - latitude))
        assert above == pytest.approx(below, rel=0.03)


@pytest.mark.parametrize("projection", ["erp", "tangent"])
def test_known_numbers(projection: str):
    """Numbers of another program."""
    for sigma, percents in REFERENCE[projection].items():
        for latitude, percent in percents.items():
            if 2 <= sigma <= 10:  # below, the same code is slow; above, the programs differ, as the table shows
                assert 100 * footprint_error(projection, sigma, latitude) == pytest.approx(percent, abs=0.25), sigma


def test_the_table_in_the_docs_is_current():
    rows = re.findall(r"^\| (erp|tangent|cubemap) \| ([\d.]+)° \| (.*) \|$", PAGE.read_text(), re.MULTILINE)
    assert [(name, float(sigma)) for name, sigma, _ in rows] == [
        (name, sigma) for name in ("erp", "tangent", "cubemap") for sigma in SIGMAS
    ]
    for projection, sigma, cells in rows:
        if float(sigma) < 5:
            continue  # the same code, but slow
        for latitude, cell in zip(LATITUDES, cells.split(" | "), strict=True):
            shown = float(cell.split(" ")[0])
            assert 100 * footprint_error(projection, float(sigma), latitude) == pytest.approx(shown, abs=0.051)
