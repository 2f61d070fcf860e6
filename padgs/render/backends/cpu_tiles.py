"""Projected Gaussians and the tile lists of an image, strip by strip (csrc/cpu/bin.cpp).

How many (Gaussian, tile) instances a row of tiles has is known before anything of that size is allocated. Where all of
them together exceed the limit, the image is drawn in strips of tile rows instead of failing.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator

import torch

from padgs.native import cpu
from padgs.native.abi import Inputs, NativeCamera, TileGrid, pointer

TILE = 16  # pixels


class Strip:
    """The lists of some rows of tiles."""

    def __init__(self, projected: Projected, first_row: int, end_row: int) -> None:
        camera, count = projected.camera, len(projected.boxes)
        columns = -(-camera.width // TILE)
        per_row = -(-columns // (1 << projected.level[first_row:end_row].long()))
        self._row_start = torch.cat((torch.zeros(1, dtype=torch.int64), per_row.cumsum(0)))
        self._level = projected.level
        self.tiles = int(self._row_start[-1])
        self.grid = TileGrid(
            camera.width, camera.height, first_row, end_row, pointer(self._level), pointer(self._row_start)
        )
        self.slot_start = torch.empty(count + 1, dtype=torch.int64)
        self.tile_start = torch.empty(self.tiles + 1, dtype=torch.int64)
        self.instances = torch.empty(int(projected.per_row[first_row:end_row].sum()), 3, dtype=torch.int32)
        cpu.library().padgs_bin(
            pointer(projected.boxes),
            count,
            pointer(projected.order),
            projected.visible,
            ctypes.byref(self.grid),
            pointer(self.slot_start),
            pointer(self.tile_start),
            pointer(self.instances),
        )


class Projected:
    """All Gaussians as one view sees them, in depth order, and how they spread over the tiles."""

    def __init__(self, camera: NativeCamera, inputs: Inputs, max_instances: int) -> None:
        library, count = cpu.library(), inputs.count
        rows = -(-camera.height // TILE)
        self.camera = camera
        self.footprints = torch.empty(count, 16)
        self.boxes = torch.empty(count, 5, dtype=torch.int32)
        library.padgs_project(ctypes.byref(camera), ctypes.byref(inputs), pointer(self.footprints), pointer(self.boxes))
        self.order = torch.empty(count, dtype=torch.int32)
        self.visible = library.padgs_depth_order(
            pointer(self.footprints), pointer(self.boxes), count, pointer(self.order)
        )
        self.level = torch.empty(rows, dtype=torch.int32)
        library.padgs_tile_levels(ctypes.byref(camera), pointer(self.level))
        self.per_row = torch.empty(rows, dtype=torch.int64)
        library.padgs_count_instances(pointer(self.boxes), count, pointer(self.level), rows, pointer(self.per_row))
        self.instances = int(self.per_row.sum())
        self._cuts = strip_cuts(self.per_row.tolist(), max_instances)
        self._only: Strip | None = None

    def strips(self) -> Iterator[Strip]:
        """The strips of the image from top to bottom; a single one is kept for the backward pass, more are not."""
        if len(self._cuts) == 2:
            if self._only is None:
                self._only = Strip(self, *self._cuts)
            yield self._only
            return
        for first, end in zip(self._cuts, self._cuts[1:], strict=False):
            yield Strip(self, first, end)


def strip_cuts(per_row: list[int], max_instances: int) -> list[int]:
    """Where to cut so that no strip exceeds the limit, unless a single row of tiles does."""
    cuts, inside = [0], 0
    for row, instances in enumerate(per_row):
        if inside and inside + instances > max_instances:
            cuts.append(row)
            inside = 0
        inside += instances
    return [*cuts, len(per_row)]
