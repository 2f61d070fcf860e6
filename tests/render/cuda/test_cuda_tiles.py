"""Tile lists and index arithmetic of the GPU backend, against loops over pixels; on the host."""

from __future__ import annotations

import ctypes

import cuda_engine
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from render_cases import INPUTS, camera_of, identity_pose, mixture, random_pose
from torch import Tensor

from padgs.native import cuda
from padgs.native.abi import Inputs, Pointer, pointer
from padgs.render import RenderOptions
from padgs.render.backends.cpu_tiles import TILE
from padgs.render.backends.cuda_tiles import BUCKET, DeviceProjected, TileRows
from padgs.render.backends.native_camera import native_camera

pytestmark = [
    pytest.mark.skipif(cuda_engine.COMPILER is None, reason="no C++ compiler to run the arithmetic on the host"),
    pytest.mark.skipif(cuda_engine.ON_GPU, reason="looks into memory of the host; the GPU's lists are drawn from"),
]
CPU = torch.device("cpu")


def projected(
    size: tuple[int, int], options: RenderOptions, lens: str, generator: torch.Generator, pose: Tensor
) -> DeviceProjected:
    gaussians = mixture(12, generator)
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
    view = projected(size, options, lens, generator, pose)
    boxes, depths = view.boxes.tolist(), view.footprints[:, 12]
    drawn = [i for i, box in enumerate(boxes) if box[3] < box[4]]
    assert view.order[: view.visible].tolist() == sorted(drawn, key=lambda i: (depths[i].item(), i))
    touched = {i: pixels_of(boxes[i], size) for i in drawn}
    level, seen = view.rows.levels, 0
    for strip in view.strips():
        tile = 0
        for row in range(strip.first_row, strip.end_row):
            for column in range(view.rows.tiles[row]):
                wide = TILE << level[row]
                inside = {
                    i: [(y - row * TILE, (x - column * wide) // TILE) for y, x in touched[i]
                        if y // TILE == row and x // wide == column]
                    for i in drawn
                }  # fmt: skip
                first, end = strip.tile_start[tile : tile + 2].tolist()
                reaches = strip.reaches[strip.slots[first:end].long()]
                wanted = [i for i in view.order[: view.visible].tolist() if inside[i]]
                assert reaches[:, 0].tolist() == wanted
                for gaussian, packed in reaches.tolist():
                    rows, chunks = zip(*inside[gaussian], strict=True)
                    top, bottom, left, right = (packed >> shift & 255 for shift in (0, 8, 16, 24))
                    assert (top, bottom) == (min(rows), max(rows) + 1)
                    assert left <= min(chunks) and max(chunks) < right
                seen += end - first
                tile += 1
    assert seen == view.instances > 100


def test_slots_of_a_gaussian_are_consecutive_and_everybody_has_one(generator: torch.Generator):
    view = projected((131, 77), RenderOptions(), "panorama", generator, identity_pose())
    (strip,) = view.strips()
    counts = torch.bincount(strip.reaches[:, 0].long(), minlength=len(view.order))
    starts = strip.slot_start.long()
    assert torch.equal(starts.diff(), counts[view.order[: view.visible].long()])
    assert torch.equal(torch.sort(strip.slots.long()).values, torch.arange(view.instances))
    owners = torch.repeat_interleave(view.order[: view.visible].long(), starts.diff())
    assert torch.equal(strip.reaches[:, 0].long(), owners)


ROWS = st.lists(st.tuples(st.integers(0, 4), st.lists(st.integers(0, 100), min_size=16, max_size=16)), min_size=1)


@settings(max_examples=60)
@given(ROWS.filter(lambda rows: len(rows) < 9), st.data())
def test_every_bucket_has_room_of_its_own_for_its_pixels(rows, data):
    """Over all tiles, buckets and chunks of any lists: no place twice, none outside."""
    width = 16 * TILE
    table = TileRows([level for level, _ in rows], width, CPU)
    per_tile = [counts[: table.tiles[r]] for r, (_, counts) in enumerate(rows)]
    instances = [sum(counts) for counts in per_tile]
    first = data.draw(st.integers(0, len(rows) - 1))
    end = data.draw(st.integers(first + 1, len(rows)))
    starts = torch.tensor(table.state_starts(instances))
    flat = torch.tensor([0, *(count for counts in per_tile[first:end] for count in counts)]).cumsum(0)
    tile_start, tiles = flat.to(torch.int32), len(flat) - 1
    tensors = (table.level, table.row_start, starts)
    native_table = cuda.TileTable(width, len(rows) * TILE, first, end, *map(pointer, tensors))

    library = cuda_engine.layout_library()
    buckets = int(tile_start[-1]) // BUCKET + tiles
    tile_of = torch.empty(buckets, dtype=torch.int32)
    library.check_buckets(Pointer(tile_start.data_ptr()), tiles, ctypes.c_int64(buckets), Pointer(tile_of.data_ptr()))
    wanted = [t for t in range(tiles) for _ in range(-(-int(tile_start[t + 1] - tile_start[t]) // BUCKET))]
    assert [t for t in tile_of.tolist() if t >= 0] == wanted

    taken: list[int] = []
    row_of_tile = [r for r in range(first, end) for _ in range(table.tiles[r])]
    for bucket, tile in enumerate(tile_of.tolist()):
        if tile < 0:
            continue
        places = torch.empty(16, dtype=torch.int64)
        row = library.check_states(
            ctypes.byref(native_table), Pointer(tile_start.data_ptr()), tile, ctypes.c_int64(bucket),
            Pointer(places.data_ptr()),
        )  # fmt: skip
        assert row == row_of_tile[tile]
        taken += places[: 1 << table.levels[row]].tolist()
    assert len(set(taken)) == len(taken)
    assert all(0 <= place < starts[end] - starts[first] for place in taken)


@pytest.mark.parametrize(("device", "current"), [(1, 0), (0, 0), (0, 2)])
@pytest.mark.parametrize(("of_work", "of_launch", "error"), [(0, 0, 0), (2, 0, 2), (0, 700, 700), (2, 700, 2)])
def test_work_on_a_device_leaves_the_thread_its_own_and_no_error(device, current, of_work, of_launch, error):
    found = torch.empty(3, dtype=torch.int32)
    check = cuda_engine.layout_library().check_on_device
    assert check(device, current, of_work, of_launch, Pointer(found.data_ptr())) == error
    assert found.tolist() == [device, current, 0]


def test_blocks_draw_every_chunk_once():
    table = TileRows([2, 1, 0], 5 * TILE - 3, CPU)  # five chunks across
    native_table = cuda.TileTable(5 * TILE - 3, 40, 1, 3, *map(pointer, (table.level, table.row_start)))
    library = cuda_engine.layout_library()
    library.check_blocks.restype = ctypes.c_int64
    blocks = library.check_blocks(ctypes.byref(native_table), None)
    places = torch.empty(blocks, 6, dtype=torch.int32)
    library.check_blocks(ctypes.byref(native_table), Pointer(places.data_ptr()))
    row, level, tile, chunk, x0, y0 = places.unbind(1)
    assert row.tolist() == [1] * 5 + [2] * 5 and level.tolist() == [1] * 5 + [0] * 5
    assert tile.tolist() == [0, 0, 1, 1, 2, 3, 4, 5, 6, 7]
    assert chunk.tolist() == [0, 1, 0, 1, 0, 0, 0, 0, 0, 0]
    assert x0.tolist() == [0, 16, 32, 48, 64] * 2 and y0.tolist() == [16] * 5 + [32] * 5


@given(st.lists(st.integers(0, 20)).map(sorted), st.integers(0, 21))
def test_lists_begin_at_the_first_key_that_is_not_less(keys: list[int], key: int):
    library = cuda_engine.layout_library()
    library.check_lower_bound.restype = ctypes.c_int64
    values = torch.tensor(keys, dtype=torch.int32)
    found = library.check_lower_bound(Pointer(values.data_ptr()), ctypes.c_int64(len(keys)), key)
    assert found == sum(k < key for k in keys)
