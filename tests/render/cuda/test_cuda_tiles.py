"""Tile lists and index arithmetic of the GPU backend, against loops over pixels; on the host."""

import ctypes
import itertools
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support import cuda_engine
from support.render_cases import INPUTS, camera_of, gaussians_of, identity_pose, mixture, random_pose
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.native import cuda
from padgs.native.abi import Inputs, Pointer, fields, pointer
from padgs.render import RenderOptions
from padgs.render.backends.cuda import DeviceProjected, DeviceStrip
from padgs.render.backends.native import TILE, native_camera

pytestmark = [
    pytest.mark.skipif(cuda_engine.COMPILER is None, reason="no C++ compiler to run the arithmetic on the host"),
    pytest.mark.skipif(cuda_engine.ON_GPU, reason="looks into memory of the host; the GPU's lists are drawn from"),
]
CPU = torch.device("cpu")


def projected(
    size: tuple[int, int], options: RenderOptions, lens: str, gaussians: Gaussians, pose: Tensor
) -> DeviceProjected:
    inputs = [getattr(gaussians, name).float() for name in INPUTS]
    structure = Inputs(len(gaussians), *map(pointer, inputs), None)
    camera = native_camera(identity_pose(), camera_of(lens, *size), options)
    return DeviceProjected(camera, pose.float(), structure, options.max_instances)


def pixels_of(box: list[int], size: tuple[int, int]) -> set[tuple[int, int]]:
    column, column_end, second_end, row, row_end = box
    columns = [*range(column, column_end), *range(second_end)]
    return {(y, x) for y in range(row, row_end) for x in columns}


@pytest.mark.parametrize(
    ("size", "options", "lens"),
    [
        ((72, 36), RenderOptions(), "panorama"),
        ((190, 90), RenderOptions("tangent"), "panorama"),
        ((131, 77), RenderOptions("ray", max_instances=100), "panorama"),
        ((80, 50), RenderOptions(bounds="square", wrap=False), "panorama"),
        ((70, 44), RenderOptions("pinhole"), "pinhole"),
    ],
)
def test_each_tile_lists_the_gaussians_whose_boxes_touch_it_front_to_back(size, options, lens, generator):
    pose = random_pose(generator) if lens == "panorama" else identity_pose()
    view = projected(size, options, lens, mixture(12, generator), pose)
    boxes, depths = view.boxes.tolist(), view.footprints[:, 12]
    drawn = [i for i, box in enumerate(boxes) if box[3] < box[4]]
    assert view.order[: view.visible].tolist() == sorted(drawn, key=lambda i: (depths[i].item(), i))
    touched: dict[tuple[int, int], dict[int, list[tuple[int, int]]]] = {}  # tile -> Gaussian -> pixels of the tile
    for i in view.order[: view.visible].tolist():
        for y, x in pixels_of(boxes[i], size):
            touched.setdefault((y // TILE, x // TILE), {}).setdefault(i, []).append((y % TILE, x % TILE))
    seen, columns = 0, range(-(-size[0] // TILE))
    for strip in view.strips():
        for tile, place in enumerate(itertools.product(range(strip.table.first_row, strip.table.end_row), columns)):
            first, end = strip.tile_start[tile : tile + 2].tolist()
            reaches = strip.reaches[strip.slots[first:end].long()]
            assert reaches[:, 0].tolist() == list(touched.get(place, {}))
            for gaussian, packed in reaches.tolist():
                rows, along = zip(*touched[place][gaussian], strict=True)
                top, bottom, left, right = (packed >> shift & 255 for shift in (0, 8, 16, 24))
                assert (top, bottom, left, right) == (min(rows), max(rows) + 1, min(along), max(along) + 1)
            seen += end - first
    assert seen == view.instances > 100


def test_slots_of_a_gaussian_are_consecutive(generator: torch.Generator):
    view = projected((131, 77), RenderOptions(), "panorama", mixture(12, generator), identity_pose())
    (strip,) = view.strips()
    counts = torch.bincount(strip.reaches[:, 0].long(), minlength=len(view.order))
    starts = strip.slot_start.long()
    assert torch.equal(starts.diff(), counts[view.order[: view.visible].long()])
    assert torch.equal(torch.sort(strip.slots.long()).values, torch.arange(view.instances))
    owners = torch.repeat_interleave(view.order[: view.visible].long(), starts.diff())
    assert torch.equal(strip.reaches[:, 0].long(), owners)


def test_no_slots_without_instances(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch):
    """One row of tiles is more than a strip holds, and there is nothing below it."""
    gaussians = gaussians_of("ordinary", 20, generator)
    above = torch.tensor([0.0, -2.0, 0.3], dtype=torch.float64) + 0.1 * gaussians.means
    gaussians = replace(gaussians, means=above, scales=0.02 * gaussians.scales)
    monkeypatch.setattr(torch, "empty", lambda *size, **options: torch.full(size, 7, **options))  # what nobody wrote
    first, rest = projected((131, 77), RenderOptions(max_instances=5), "panorama", gaussians, identity_pose()).strips()
    assert first.instances > 5 and rest.instances == 0
    assert not rest.slot_start.any(), "else the backward pass adds up what lies anywhere"


def test_instance_counts_beyond_32_bits():
    """Slots must not wrap around to 0, where they would overwrite the first ones."""
    side, count, capacity = 8192, 16_400, 100
    view = DeviceProjected.__new__(DeviceProjected)
    view.camera = native_camera(identity_pose(), camera_of("pinhole", side, side), RenderOptions("pinhole"))
    view.queue, view.capacity, view.visible = cuda.queue(CPU), capacity, count
    view.boxes = torch.tensor([0, side, 0, 0, side], dtype=torch.int32).repeat(count, 1)
    view.order = torch.arange(count, dtype=torch.int32)
    strip = DeviceStrip(view, 0, side // 16)
    assert count * strip.tiles > 2**32
    wanted = (strip.tiles * torch.arange(count + 1)).clamp(max=2**31 - 1)
    assert torch.equal(strip.slot_start.long(), wanted)
    assert (strip.reaches[:, 0] == 0).all()
    assert torch.equal(strip.tile_start.long(), torch.arange(strip.tiles + 1).clamp(max=capacity))


@pytest.mark.parametrize(("device", "current"), [(1, 0), (0, 0), (0, 2)])
@pytest.mark.parametrize(("of_work", "of_launch", "error"), [(0, 0, 0), (2, 0, 2), (0, 700, 700), (2, 700, 2)])
def test_device_guard_restores_device_and_clears_errors(device, current, of_work, of_launch, error):
    found = torch.empty(3, dtype=torch.int32)
    check = cuda_engine.layout_library().check_on_device
    assert check(device, current, of_work, of_launch, Pointer(found.data_ptr())) == error
    assert found.tolist() == [device, current, 0]


class PixelPlace(ctypes.Structure):
    _fields_ = [
        *fields(ctypes.c_int32, "column", "row", "x", "y"),
        ("inside", ctypes.c_bool),
        ("index", ctypes.c_int64),
    ]


EDGES = st.tuples(st.integers(0, 15), st.integers(1, 16)).filter(lambda edge: edge[0] < edge[1])


@settings(max_examples=20)
@given(st.lists(st.tuples(EDGES, EDGES), min_size=1, max_size=8))
def test_every_pixel_has_one_thread(reaches):
    width, height, threads = 5 * TILE - 3, 40, 2 * 5 * 256
    table = cuda.TileTable(width, height, 1, 3)
    packed = [top | bottom << 8 | left << 16 | right << 24 for (top, bottom), (left, right) in reaches]
    instances = torch.tensor([[0, one] for one in packed], dtype=torch.int64).to(torch.int32)
    places, reached = (PixelPlace * threads)(), (ctypes.c_int32 * threads)()
    cuda_engine.layout_library().check_pixels(
        ctypes.byref(table), Pointer(instances.data_ptr()), len(reaches), places, reached
    )
    inside = [place for place in places if place.inside]
    assert {(place.x, place.y) for place in inside} == {(x, y) for x in range(width) for y in range(TILE, height)}
    assert len(inside) == width * (height - TILE) and all(p.index == p.y * width + p.x for p in inside)
    for thread in range(0, threads, 32):  # a warp
        tile, warp = thread // 256, [(place.x % TILE, place.y % TILE) for place in places[thread : thread + 32]]
        assert {(p.x // TILE, p.y // TILE - 1) for p in places[thread : thread + 32]} == {(tile % 5, tile // 5)}
        wanted = sum(
            any(left <= x < right and top <= y < bottom for x, y in warp) << k
            for k, ((top, bottom), (left, right)) in enumerate(reaches)
        )
        assert set(reached[thread : thread + 32]) == {wanted}


@pytest.mark.parametrize("count", range(1, 17))
def test_each_sum_belongs_to_one_lane(count: int):
    index = (ctypes.c_int32 * 32)()
    cuda_engine.layout_library().check_dealt_index(count, index)
    assert sorted(one for one in index if one >= 0) == list(range(count))


@given(st.lists(st.integers(0, 20)).map(sorted), st.integers(0, 21))
def test_lists_begin_at_the_first_key_that_is_not_less(keys: list[int], key: int):
    library = cuda_engine.layout_library()
    library.check_lower_bound.restype = ctypes.c_int64
    values = torch.tensor(keys, dtype=torch.int32)
    found = library.check_lower_bound(Pointer(values.data_ptr()), ctypes.c_int64(len(keys)), key)
    assert found == sum(k < key for k in keys)
