import math

import pytest
import torch
from torch.nn.functional import normalize

from padgs.methods.egonerf.grids import YANG, YIN, ChartPosition, direction, locate, swapped

YIN_SHARE = math.sqrt(2) * 1.5 * math.pi / (4 * math.pi)  # 2 sin(pi/4) x 3 pi/2 of the 4 pi


@pytest.fixture
def directions(generator) -> torch.Tensor:
    return normalize(torch.randn(100_000, 3, dtype=torch.float64, generator=generator), dim=-1)


def in_yin(directions: torch.Tensor) -> torch.Tensor:
    """The definition, by angles."""
    x, y, z = directions.unbind(-1)
    polar, azimuth = torch.acos(z), torch.atan2(y, x)
    return (polar >= math.pi / 4) & (polar <= 3 * math.pi / 4) & (azimuth.abs() <= 3 * math.pi / 4)


def test_every_direction_has_one_chart_and_the_charts_share_the_sphere_as_their_areas_do(directions):
    chart = locate(directions).chart
    assert torch.equal(chart == YIN, in_yin(directions))
    assert ((chart == YIN) | (chart == YANG)).all()
    share = (chart == YIN).double().mean().item()
    assert share == pytest.approx(YIN_SHARE, abs=4 * math.sqrt(0.25 / len(directions)))


def test_what_is_not_yin_fits_into_the_chart_of_yang(directions):
    """So nothing has to be clamped: the two charts cover the sphere."""
    assert in_yin(swapped(directions[~in_yin(directions)])).all()


def test_places_and_directions_are_inverse(directions):
    assert torch.allclose(direction(locate(directions)), directions, atol=1e-12)
    assert torch.allclose(direction(locate(directions * 7.5)), directions, atol=1e-12), "length does not matter"


def test_neither_chart_has_a_pole(directions):
    """An equal step in a chart's azimuth is never shorter on the sphere than 1 / sqrt 2 of one at its equator."""
    place = locate(directions)
    step = 1e-6
    moved = direction(ChartPosition(place.chart, place.polar, place.azimuth - step))
    per_step = (moved - directions).norm(dim=-1) / (step * 1.5 * math.pi)
    assert per_step.min() > 1 / math.sqrt(2) - 1e-6 and per_step.max() < 1 + 1e-6


def test_the_axes_are_where_they_belong():
    axes = torch.cat((torch.eye(3), -torch.eye(3))).double()
    assert locate(axes).chart.tolist() == [YIN, YIN, YANG, YANG, YIN, YANG]


def test_the_centre_itself_is_somewhere():
    place = locate(torch.zeros(1, 3))
    assert all(0 <= value <= 1 for value in (place.polar.item(), place.azimuth.item()))
