"""Pixel boxes and tile lists of the native library as tensors."""

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.geometry.camera import Camera
from padgs.native.abi import Inputs, pointer
from padgs.render import RenderOptions
from padgs.render.backends.cpu import Projected
from padgs.render.backends.native import TILE, native_camera
from support.render_cases import INPUTS


def projected(gaussians: Gaussians, camera: Camera, options: RenderOptions, pose: Tensor) -> Projected:
    inputs = [getattr(gaussians, name).float().contiguous() for name in INPUTS]
    structure = Inputs(len(gaussians), *map(pointer, inputs), None)
    return Projected(native_camera(pose, camera, options), structure, options.max_instances)


def pixel_boxes(gaussians: Gaussians, camera: Camera, options: RenderOptions, pose: Tensor) -> Tensor:
    """Boxes [N, 5]: column, column_end, second_end (beyond the seam), row, row_end; see csrc/abi.h."""
    return projected(gaussians, camera, options, pose).boxes.long()


PATCH_WIDTH, PATCH_HEIGHT = 8, 2  # pixels, as in csrc/abi.h


class NativeTiles:
    """The tile lists of one view, in one strip."""

    def __init__(self, gaussians: Gaussians, camera: Camera, options: RenderOptions, pose: Tensor) -> None:
        self.projected = projected(gaussians, camera, options, pose)
        (strip,) = self.projected.strips()
        self.strip, self.count = strip, len(strip.instances)
        self.gaussian, self.slot, packed = strip.instances.long().unbind(1)
        reach = torch.stack([packed >> shift & 255 for shift in (0, 8, 16, 24)])  # in patches
        self.row, self.row_end = reach[:2] * PATCH_HEIGHT  # pixels from the tile's corner
        self.column, self.column_end = reach[2:] * PATCH_WIDTH
        self.tile = torch.repeat_interleave(torch.arange(strip.tiles), strip.tile_start.diff())
        self.level = self.projected.level.long()  # [rows of tiles]
        per_row = -(-camera.width // (TILE << self.level))
        self.row_of_tile = torch.repeat_interleave(torch.arange(len(self.level)), per_row)
        column_of_tile = torch.arange(strip.tiles) - (per_row.cumsum(0) - per_row)[self.row_of_tile]
        self.first_column = column_of_tile * TILE << self.level[self.row_of_tile]  # [tiles] pixels

    def times_listed(self, gaussian: int, camera: Camera) -> Tensor:
        """Return how many instances of a Gaussian contain each pixel, [H W]."""
        times = torch.zeros(camera.height, camera.width, dtype=torch.int64)
        for i in (self.gaussian == gaussian).nonzero()[:, 0].tolist():
            x, y = int(self.first_column[self.tile[i]]), int(self.row_of_tile[self.tile[i]]) * TILE
            rows = slice(y + int(self.row[i]), y + int(self.row_end[i]))
            times[rows, x + int(self.column[i]) : x + int(self.column_end[i])] += 1
        return times.flatten()
