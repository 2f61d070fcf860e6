"""Projected Gaussians and tile lists in the memory of a GPU, strip by strip; cpu_tiles.py is the CPU's.

The host reads one thing back: how many instances each row of tiles has, before anything of their size is allocated.
Where it must not wait (`padgs.render.backends.captured`), there is room for a stated number of them instead: Gaussians
that are not drawn are passed over rather than left out, and instances that do not exist have a key behind that of the
last tile.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Iterator

import torch
from torch import Tensor

from padgs.native import cuda
from padgs.native.abi import Inputs, NativeCamera, pointer
from padgs.native.cuda import Queue, SortArguments, TileTable
from padgs.render.backends.cpu_tiles import TILE, strip_cuts

MAX_INSTANCES = (1 << 31) - 1 - 512  # of one strip: positions in its lists, and a batch behind, are 32-bit integers


class DeviceStrip:
    """The lists of some rows of tiles."""

    def __init__(self, projected: DeviceProjected, first_row: int, end_row: int) -> None:
        device = projected.order.device
        self.tiles = (end_row - first_row) * -(-projected.camera.width // TILE)
        self.instances = projected.room if projected.room else sum(projected.per_row[first_row:end_row])
        if self.instances > MAX_INSTANCES:
            raise ValueError(
                f"one row of tiles has {self.instances:,} (Gaussian, tile) instances; a list holds at most "
                f"{MAX_INSTANCES:,}. Draw fewer or smaller Gaussians, or with backend=cpu"
            )
        integers = functools.partial(torch.empty, dtype=torch.int32, device=device)
        self.slot_start = integers(projected.visible + 1)
        self.reaches = integers(self.instances, 2)
        self.slots = integers(self.instances)
        self.tile_start = integers(self.tiles + 1)
        self.table = projected.table(first_row, end_row)
        counts = integers(projected.visible + 1)
        sort = Sorter(projected.queue, self.instances, device, summed=len(counts))
        largest = self.tiles if projected.room else max(self.tiles - 1, 1)
        if projected.room:
            sort.keys.fill_(largest)
            sort.values.zero_()
        arguments = cuda.BinArguments(
            self.table,
            pointer(projected.boxes),
            pointer(projected.order),
            projected.visible,
            pointer(counts),
            pointer(self.slot_start),
            pointer(self.reaches),
            sort.arguments(self.slots, bits=largest.bit_length()),
            pointer(self.tile_start),
        )
        cuda.call("padgs_cuda_bin", projected.queue, arguments, self.tiles)


class Sorter:
    """Keys, values and scratch for one stable sort, and for a sum."""

    def __init__(self, queue: Queue, count: int, device: torch.device, *, summed: int = 0) -> None:
        self.queue, self.count = queue, count
        self.keys = torch.empty(count, dtype=torch.int32, device=device)
        self.sorted_keys, self.values = torch.empty_like(self.keys), torch.empty_like(self.keys)
        scratch = cuda.library().padgs_cuda_scratch_bytes(ctypes.byref(queue), max(count, summed, 1))
        cuda.raise_for(max(-scratch, 0), "padgs_cuda_scratch_bytes")
        self.scratch = torch.empty(max(scratch, 1), dtype=torch.uint8, device=device)

    def arguments(self, sorted_values: Tensor, bits: int) -> SortArguments:
        """For the library; the tensors must outlive the call."""
        buffers = (self.keys, self.sorted_keys, self.values, sorted_values)
        return SortArguments(pointer(self.scratch), len(self.scratch), self.count, *map(pointer, buffers), bits)


class DeviceProjected:
    """All Gaussians as one view sees them, in depth order, and how they spread over the tiles."""

    def __init__(
        self, camera: NativeCamera, pose: Tensor, inputs: Inputs, max_instances: int, *, room: int = 0
    ) -> None:
        """Project, sort, count; waits for the device once, unless it is told how much room there is.

        Args:
            camera: its own pose is not used.
            pose: [4, 4] on the device, contiguous.
            inputs: on the device.
            max_instances: of a strip.
            room: for so many instances in a single strip, drawn without a look at how many there are: `counts` says on
                the device. 0: as many as there are.
        """
        device, count = pose.device, inputs.count
        self.queue = cuda.queue(device)
        self.camera = camera
        rows = -(-camera.height // TILE)
        self.footprints = torch.empty(count, 16, dtype=torch.float32, device=device)
        self.boxes = torch.empty(count, 5, dtype=torch.int32, device=device)
        self.order = torch.empty(count, dtype=torch.int32, device=device)
        self.per_row: list[int] = []
        self._only: DeviceStrip | None = None
        sort = Sorter(self.queue, count, device)
        self.counts = torch.zeros(rows + 1, dtype=torch.int64, device=device)
        outputs = (self.footprints, self.boxes, sort.keys, sort.values)
        table = self.table(0, rows)
        arguments = cuda.ProjectArguments(
            camera, pointer(pose), inputs, *map(pointer, outputs), table, pointer(self.counts)
        )
        cuda.call("padgs_cuda_project", self.queue, arguments)
        cuda.call("padgs_cuda_sort", self.queue, sort.arguments(self.order, bits=32))
        self.room, self.visible = room, count
        self._cuts = [0, rows]
        if not room:
            *self.per_row, self.visible = self.counts.tolist()
            self._cuts = strip_cuts(self.per_row, min(max_instances, MAX_INSTANCES))

    def fits(self, counts: list[int]) -> bool:
        """Whether there was room for all instances; `self.counts`, once they are known."""
        *self.per_row, self.visible = counts
        return self.instances <= self.room

    @property
    def instances(self) -> int:
        """How many there are, of all rows; known where the device was waited for."""
        return sum(self.per_row)

    def table(self, first_row: int, end_row: int) -> TileTable:
        """Some rows of tiles, for the library."""
        return TileTable(self.camera.width, self.camera.height, first_row, end_row)

    def strips(self) -> Iterator[DeviceStrip]:
        """The strips of the image from top to bottom; a single one is kept for the backward pass, more are not."""
        if len(self._cuts) == 2:
            if self._only is None:
                self._only = DeviceStrip(self, *self._cuts)
            yield self._only
            return
        for first, end in zip(self._cuts, self._cuts[1:], strict=False):
            yield DeviceStrip(self, first, end)
