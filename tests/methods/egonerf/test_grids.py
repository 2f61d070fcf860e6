"""Charts, radial nodes, and planes times lines of EgoNeRF."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.autograd import gradcheck
from torch.nn.functional import normalize

from padgs.methods.egonerf.grids import (
    MODES,
    YANG,
    YIN,
    Factors,
    GridPosition,
    PlaneLines,
    density_feature,
    exponential_nodes,
    grid_position,
    locate,
    node_fraction,
    products,
    swapped,
)

YIN_SHARE = math.sqrt(2) * 1.5 * math.pi / (4 * math.pi)  # 2 sin(pi/4) x 3 pi/2 of the 4 pi


@pytest.fixture
def directions(generator) -> torch.Tensor:
    return normalize(torch.randn(100_000, 3, dtype=torch.float64, generator=generator), dim=-1)


def in_yin(directions: torch.Tensor) -> torch.Tensor:
    """The definition, by angles."""
    x, y, z = directions.unbind(-1)
    polar, azimuth = torch.acos(z), torch.atan2(y, x)
    return (polar >= math.pi / 4) & (polar <= 3 * math.pi / 4) & (azimuth.abs() <= 3 * math.pi / 4)


def test_charts_partition_the_sphere_by_their_areas(directions):
    chart, _, _ = locate(directions)
    assert torch.equal(chart == YIN, in_yin(directions))
    assert ((chart == YIN) | (chart == YANG)).all()
    share = (chart == YIN).double().mean().item()
    assert share == pytest.approx(YIN_SHARE, abs=4 * math.sqrt(0.25 / len(directions)))
    assert in_yin(swapped(directions[~in_yin(directions)])).all(), "nothing has to be clamped"


def test_places_are_angles_in_the_axes_of_their_chart(directions):
    chart, polar, azimuth = locate(directions * 7.5)  # length does not matter
    polar, azimuth = (polar - 0.5) * math.pi / 2 + math.pi / 2, (azimuth - 0.5) * 1.5 * math.pi
    found = torch.stack((polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()), dim=-1)
    found = torch.where((chart == YIN)[:, None], found, swapped(found))
    assert torch.allclose(found, directions, atol=1e-12)


def test_charts_of_the_axes_and_the_centre():
    axes = torch.cat((torch.eye(3), -torch.eye(3))).double()
    assert locate(axes)[0].tolist() == [YIN, YIN, YANG, YANG, YIN, YANG]
    assert all(0 <= value.item() <= 1 for value in locate(torch.zeros(1, 3))[1:])


@given(first=st.floats(1e-4, 0.5), factor=st.floats(1.5, 1e5), count=st.integers(3, 300))
def test_node_intervals_grow_from_the_first(first, factor, count):
    nodes = exponential_nodes(first, first * factor, count)
    assert len(nodes) == count and nodes[0] == 0
    assert nodes[1].item() == pytest.approx(first)
    assert (nodes.diff() >= first * (1 - 1e-12)).all()
    assert (nodes.diff().diff() >= -1e-9 * nodes[-1]).all(), "intervals never shrink"
    assert nodes[-1] >= first * factor * (1 - 1e-9)


def test_node_fraction_is_piecewise_linear():
    nodes = exponential_nodes(0.1, 50.0, 24)
    steps = torch.arange(24, dtype=torch.float64) / 23
    assert torch.allclose(node_fraction(nodes, nodes), steps, atol=1e-14)
    between = 0.25 * nodes[:-1] + 0.75 * nodes[1:]
    assert torch.allclose(node_fraction(between, nodes), steps[:-1] + 0.75 / 23, atol=1e-14)
    assert torch.allclose(node_fraction(nodes[1:-1] * (1 - 1e-12), nodes), steps[1:-1], atol=1e-10)
    at = grid_position(torch.tensor([[0.6, 0.0, -0.8]]) * nodes[3], nodes)
    assert at.radius.item() == pytest.approx(3 / 23, abs=1e-6)


def test_node_fraction_is_monotone_and_clamped():
    nodes = exponential_nodes(0.1, 50.0, 24)
    radii = torch.linspace(0, 80, 10_001, dtype=torch.float64)
    places = node_fraction(radii, nodes)
    inside = radii < nodes[-1]
    assert (places.diff()[inside[1:]] > 0).all()
    assert (places[~inside] == 1).all()


SHAPE = {"radius": 6, "polar": 4, "azimuth": 8}


@pytest.fixture
def grids() -> PlaneLines:
    torch.manual_seed(5)
    made = PlaneLines(3, SHAPE).double()
    for factor in made.parameters():
        factor.data *= 10
    return made


def places(count: int, generator: torch.Generator) -> GridPosition:
    chart = torch.randint(2, (count,), generator=generator)
    radius, polar, azimuth = torch.rand(3, count, dtype=torch.float64, generator=generator)
    return GridPosition(chart, radius, polar, azimuth)


def interpolated(factor: torch.Tensor, at: GridPosition, axes: tuple[str, ...]) -> torch.Tensor:
    """Multilinear interpolation of [C, 2, ...] one point at a time, by its definition."""
    values = []
    for index in range(len(at.chart)):
        value = factor[:, at.chart[index]]
        for axis in axes:
            place = getattr(at, axis)[index] * (value.shape[1] - 1)
            low = min(int(place), value.shape[1] - 2)
            value = value[:, low] * (low + 1 - place) + value[:, low + 1] * (place - low)
        values.append(value)
    return torch.stack(values, dim=-1)


def test_products_are_interpolated_planes_times_lines(grids, generator):
    at, factors = places(50, generator), grids.factors()
    found = products(factors, at)
    for (axes, along), plane, line, product in zip(MODES, factors.planes, factors.lines, found, strict=True):
        assert torch.allclose(product, interpolated(plane, at, axes) * interpolated(line, at, (along,)), atol=1e-12)


def test_density_is_the_sum_over_modes_of_rectified_sums(grids, generator):
    at = places(50, generator)
    expected = sum(product.sum(0).clamp(min=0) for product in products(grids.factors(), at))
    assert torch.allclose(density_feature(grids.factors(), at), expected)


@pytest.mark.parametrize("chart", [YIN, YANG])
def test_charts_are_independent(grids, generator, chart):
    at = places(200, generator)
    with torch.no_grad():
        for factor in grids.parameters():
            factor[:, 1 - chart] = 1e6
    edge = at._replace(chart=torch.full_like(at.chart, chart), polar=at.polar.round(), azimuth=at.azimuth.round())
    assert torch.stack(products(grids.factors(), edge)).abs().max() < 1e3


def test_gradients_of_the_look_up(grids, generator):
    at = places(12, generator)
    parameters = tuple(grids.factors().planes) + tuple(grids.factors().lines)

    def field(*tensors: torch.Tensor) -> torch.Tensor:
        factors = Factors(tensors[:3], tensors[3:])
        return torch.cat([density_feature(factors, at), *(product.flatten() for product in products(factors, at))])

    assert gradcheck(field, parameters)


def test_coarse_grids_are_pooled(grids):
    coarse = grids.coarse()
    for fine, half in zip((*grids.planes, *grids.lines), (*coarse.planes, *coarse.lines), strict=True):
        assert all(b * 2 == a for a, b in zip(fine.shape[2:], half.shape[2:], strict=True))
        axes = tuple(range(2, fine.ndim))
        assert torch.allclose(fine.mean(axes), half.mean(axes)), "each chart and component by itself"


def test_total_variation_matches_the_published_formula(grids):
    def of_chart(plane: torch.Tensor) -> torch.Tensor:
        components, rows, columns = plane.shape
        down = (plane[:, 1:] - plane[:, :-1]).square().sum() / (components * (rows - 1) * columns)
        along = (plane[:, :, 1:] - plane[:, :, :-1]).square().sum() / (components * rows * (columns - 1))
        return 2 * (down + along)

    expected = sum(of_chart(plane[:, chart]) for plane in grids.planes for chart in (YIN, YANG))
    assert torch.allclose(grids.variation(), expected)
