import pytest
import torch
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
    products,
)

SHAPE = {"radius": 6, "polar": 4, "azimuth": 8}


@pytest.fixture
def grids() -> PlaneLines:
    torch.manual_seed(5)
    return PlaneLines(3, SHAPE, scale=1.0).double()


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
def test_a_chart_reads_nothing_of_the_other(grids, generator, chart):
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


def test_the_coarse_grid_is_half_as_fine_and_has_the_same_means(grids):
    coarse = grids.coarse()
    for fine, half in zip((*grids.planes, *grids.lines), (*coarse.planes, *coarse.lines), strict=True):
        assert all(b * 2 == a for a, b in zip(fine.shape[2:], half.shape[2:], strict=True))
        axes = tuple(range(2, fine.ndim))
        assert torch.allclose(fine.mean(axes), half.mean(axes)), "each chart and component by itself"


def test_variation_is_the_published_sum_over_charts(grids):
    def of_chart(plane: torch.Tensor) -> torch.Tensor:
        components, rows, columns = plane.shape
        down = (plane[:, 1:] - plane[:, :-1]).square().sum() / (components * (rows - 1) * columns)
        along = (plane[:, :, 1:] - plane[:, :, :-1]).square().sum() / (components * rows * (columns - 1))
        return 2 * (down + along)

    expected = sum(of_chart(plane[:, chart]) for plane in grids.planes for chart in (YIN, YANG))
    assert torch.allclose(grids.variation(), expected)


def test_points_are_found_by_distance_and_direction(generator):
    nodes = exponential_nodes(0.1, 20.0, 6)
    directions = normalize(torch.randn(100, 3, dtype=torch.float64, generator=generator), dim=-1)
    at = grid_position(directions * nodes[3], nodes)
    assert torch.allclose(at.radius, torch.full_like(at.radius, 3 / 5))
