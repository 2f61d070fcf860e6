"""Grids, cells and the initial size of anchors."""

import math

import pytest
import torch

from padgs.methods.anchors.anchors import (
    anchors_from_points,
    automatic_voxel_size,
    cell_keys,
    cells_from_points,
    initial_log_scales,
    occupied,
    points_from_cells,
    unique_cells,
)
from padgs.scene import Scene, View


def test_points_go_to_the_nearest_vertex_once():
    points = torch.tensor([[0.24, 0.0, 0.0], [0.26, 0.0, 0.0], [-0.26, 0.6, 0.0], [0.2, 0.1, -0.1]])
    expected = torch.tensor([[-0.5, 0.5, 0.0], [0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    assert torch.equal(anchors_from_points(points, 0.5), expected)


def test_halves_go_to_even():
    halves = torch.tensor([[0.5, 1.5, -0.5]])
    assert cells_from_points(halves, 1.0).tolist() == [[0, 2, 0]]


@pytest.mark.parametrize("size", [0.001, 0.037, 5.0])
def test_cells_survive_the_way_through_float32_positions(size, generator):
    cells = torch.randint(-(2**20), 2**20, (2000, 3), generator=generator)
    assert torch.equal(cells_from_points(points_from_cells(cells, size), size), cells)


@pytest.mark.parametrize("spread", [3, 2**40])  # narrow: digits of one number; wide: more than 64 bits
def test_unique_cells_are_those_of_python(spread, generator):
    cells = torch.randint(-spread, spread, (300, 3), generator=generator)
    cells = torch.cat((cells, cells[::3], torch.tensor([[-spread] * 3, [spread] * 3])))
    unique, inverse = unique_cells(cells)
    assert [tuple(row) for row in unique.tolist()] == sorted({tuple(row) for row in cells.tolist()})
    assert torch.equal(unique[inverse], cells)
    assert len(cell_keys(cells).unique()) == len(unique)


@pytest.mark.parametrize("spread", [3, 2**40])
def test_occupied_are_those_of_python(spread, generator):
    by = torch.randint(-spread, spread, (200, 3), generator=generator)
    cells = torch.cat((torch.randint(-spread, spread, (200, 3), generator=generator), by[::7]))
    there = {tuple(row) for row in by.tolist()}
    assert occupied(cells, by).tolist() == [tuple(row) in there for row in cells.tolist()]


def test_no_cells_are_no_problem():
    nothing = torch.zeros(0, 3, dtype=torch.int64)
    assert [len(part) for part in unique_cells(nothing)] == [0, 0]
    assert occupied(nothing, torch.ones(2, 3, dtype=torch.int64)).shape == (0,)
    assert occupied(torch.ones(2, 3, dtype=torch.int64), nothing).tolist() == [False, False]


def test_initial_scale_is_the_root_mean_square_of_three_distances():
    positions = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0, 2.0, 0], [0, 0, 3.0], [100.0, 0, 0]])
    log_scales = initial_log_scales(positions, 1.0)
    assert log_scales.shape == (5, 6) and log_scales.dtype == torch.float32
    assert torch.allclose(log_scales[0], torch.tensor(0.5 * math.log((1 + 4 + 9) / 3)))


def test_initial_scale_of_few_anchors():
    assert initial_log_scales(torch.zeros(1, 3), 0.25).eq(math.log(0.25)).all()
    two = initial_log_scales(torch.tensor([[0.0, 0, 0], [0, 4.0, 0]]), 1.0)
    assert torch.allclose(two, torch.tensor(math.log(4.0)))


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_automatic_voxel_is_an_angle_at_the_training_resolution(scale):
    points = scale * torch.tensor([[0.0, 0.0, 5.0], [0.0, 5.0, 0.0], [-5.0, 0.0, 0.0]])
    view = View("v", torch.eye(4, dtype=torch.float64), 400, 200)
    scene = Scene("s", (view,), (), points, torch.zeros(3, 3, dtype=torch.uint8), "0")
    assert automatic_voxel_size(scene, 0.25) == pytest.approx(0.25 * math.pi / 200 * 5.0 * scale)


def test_bad_clouds_and_sizes_are_named():
    with pytest.raises(ValueError, match="point cloud is empty"):
        anchors_from_points(torch.zeros(0, 3), 0.1)
    with pytest.raises(ValueError, match="point 1 of the cloud is"):
        anchors_from_points(torch.tensor([[0.0, 0, 0], [0, float("nan"), 0]]), 0.1)
    for size in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match="voxel_size is"):
            anchors_from_points(torch.zeros(1, 3), size)
