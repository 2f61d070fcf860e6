"""The native CPU rasterizer: tiles, SIMD, OpenMP (csrc/cpu). float32 only.

Results do not depend on the number of threads: tiles write their own pixels, every (Gaussian, tile) instance has its
own slot for the gradient sums of the backward pass, and the slots of a Gaussian are summed in order.
"""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from padgs.native import abi, cpu
from padgs.native.abi import Inputs, pointer
from padgs.render.backends import native
from padgs.render.contract import Removals


class Strip:
    """Tile lists of some rows of tiles (csrc/cpu/bin.cpp)."""

    def __init__(self, projected: Projected, first_row: int, end_row: int) -> None:
        camera, count = projected.camera, len(projected.boxes)
        columns = -(-camera.width // native.TILE)
        per_row = -(-columns // (1 << projected.level[first_row:end_row].long()))
        self._row_start = torch.cat((torch.zeros(1, dtype=torch.int64), per_row.cumsum(0)))
        self._level = projected.level
        self.tiles = int(self._row_start[-1])
        lists = map(pointer, (self._level, self._row_start))
        self.grid = abi.TileGrid(camera.width, camera.height, first_row, end_row, *lists)
        self.slot_start = torch.empty(count + 1, dtype=torch.int64)
        self.tile_start = torch.empty(self.tiles + 1, dtype=torch.int64)
        self.instances = torch.empty(int(projected.per_row[first_row:end_row].sum()), 3, dtype=torch.int32)
        gaussians = (pointer(projected.boxes), count, pointer(projected.order), projected.visible)
        outputs = map(pointer, (self.slot_start, self.tile_start, self.instances))
        cpu.library().padgs_bin(*gaussians, ctypes.byref(self.grid), *outputs)


class Projected(native.Strips):
    """All Gaussians projected to one view, in depth order, with the number of instances in each row of tiles.

    The number of instances is known before anything is allocated; above the limit, strips of tile rows are drawn.
    """

    def __init__(self, camera: abi.NativeCamera, inputs: Inputs, max_instances: int) -> None:
        library, count = cpu.library(), inputs.count
        rows = -(-camera.height // native.TILE)
        self.camera = camera
        self.footprints = torch.empty(count, 16)
        self.boxes = torch.empty(count, 5, dtype=torch.int32)
        library.padgs_project(ctypes.byref(camera), ctypes.byref(inputs), pointer(self.footprints), pointer(self.boxes))
        self.order = torch.empty(count, dtype=torch.int32)
        footprints, boxes = pointer(self.footprints), pointer(self.boxes)
        self.visible = library.padgs_depth_order(footprints, boxes, count, pointer(self.order))
        self.level = torch.empty(rows, dtype=torch.int32)
        library.padgs_tile_levels(ctypes.byref(camera), pointer(self.level))
        self.per_row = torch.empty(rows, dtype=torch.int64)
        library.padgs_count_instances(pointer(self.boxes), count, pointer(self.level), rows, pointer(self.per_row))
        self.instances = int(self.per_row.sum())
        super().__init__(Strip, native.strip_cuts(self.per_row.tolist(), max_instances))


class _Image(native.NativeImage):
    @staticmethod
    def check(means: Tensor) -> None:
        if means.dtype != torch.float32 or means.device.type != "cpu":
            raise ValueError(
                f"backend cpu takes float32 tensors on the CPU, got {means.dtype} on {means.device}; convert them, or "
                "use backend=torch"
            )

    def draw(
        self, inputs: Inputs, pose: Tensor, background: Tensor, *, differentiated: bool
    ) -> tuple[native.Pixels, Tensor]:
        camera, options = self.camera, self.options
        self._projected = Projected(native.native_camera(pose, camera, options), inputs, options.max_instances)
        self.rays = native.native_rays(camera)
        size = (camera.height, camera.width)
        pixels = (torch.empty(*size, 3), torch.empty(size), torch.empty(size))
        self._last = torch.empty(size, dtype=torch.int32)  # position of the last contribution to each pixel
        pairs = torch.zeros(2, dtype=torch.int64)
        self._cores: list[tuple[Tensor, Tensor]] = []  # words and starts of each strip, if kept (csrc/cpu/kept_cores.h)
        for strip in self._projected.strips():
            pair_counts = torch.empty(strip.tiles, 2, dtype=torch.int64)
            arguments = self._blend_arguments(strip, background, pixels, pair_counts)
            if differentiated and options.blending == "hybrid":  # the system provides memory only for the used part
                words = cpu.library().padgs_core_words(ctypes.byref(arguments))
                kept = torch.empty(words, dtype=torch.int32), torch.zeros(strip.tiles + 1, dtype=torch.int64)
                self._cores.append(kept)
                arguments.cores, arguments.core_start = map(pointer, kept)
            cpu.library().padgs_blend_forward(ctypes.byref(arguments))
            pairs += pair_counts.sum(0)
        self.counters = {
            "gaussians": inputs.count,
            "visible": self._projected.visible,
            "instances": self._projected.instances,
            "evaluated": int(pairs[0]),
            "contributing": int(pairs[1]),
        }
        return pixels, self._projected.boxes[:, 3] < self._projected.boxes[:, 4]

    def gradient_sums(self, pixels: native.Pixels, background: Tensor, upstream: native.Upstream) -> Tensor:
        count = len(self._projected.boxes)
        totals = torch.zeros(count, abi.GRADIENT_SUMS)
        for number, strip in enumerate(self._projected.strips()):
            forward = self._blend_arguments(strip, background, pixels, None)
            if self._cores:
                forward.cores, forward.core_start = map(pointer, self._cores[number])
            sums = torch.empty(len(strip.instances), abi.GRADIENT_SUMS)
            grads = (upstream.image, upstream.transmittance, upstream.depth, sums, upstream.rays)
            arguments = abi.BlendGradientArguments(forward, *map(pointer, grads), upstream.absgrad)
            cpu.library().padgs_blend_backward(ctypes.byref(arguments))
            cpu.library().padgs_sum_moments(pointer(sums), pointer(strip.slot_start), count, pointer(totals))
        return totals

    def removals(self, pixels: native.Pixels, background: Tensor, target: Tensor, weight: Tensor) -> Removals:
        count = len(self._projected.boxes)
        sums, peak = torch.zeros(count, abi.REMOVAL - 1, dtype=torch.float64), torch.zeros(count)
        for strip in self._projected.strips():
            forward = self._blend_arguments(strip, background, pixels, None)
            found = torch.empty(len(strip.instances), abi.REMOVAL)
            arguments = abi.LeaveOneOutArguments(forward, *map(pointer, (target, weight, found)))
            cpu.library().padgs_leave_one_out(ctypes.byref(arguments))
            owner = torch.repeat_interleave(torch.arange(count), strip.slot_start.diff())
            sums.index_add_(0, owner, found[:, :-1].double())
            peak.scatter_reduce_(0, owner, found[:, -1], "amax")
        error, change, contribution = sums.unbind(-1)
        return Removals(error, change, contribution, peak)

    def project_backward(
        self, inputs: Inputs, pose: Tensor, sums: Tensor, gradients: list[Tensor | None], *, needs_pose: bool
    ) -> Tensor | None:
        pose_gradient = torch.zeros(12, dtype=torch.float64) if needs_pose else None
        out = abi.Gradients(*map(pointer, (*gradients, pose_gradient)))
        camera, given, found = map(ctypes.byref, (self._projected.camera, inputs, out))
        cpu.library().padgs_project_backward(camera, given, pointer(sums), found)
        return pose_gradient

    def _blend_arguments(
        self, strip: Strip, background: Tensor, pixels: native.Pixels, pair_counts: Tensor | None
    ) -> abi.BlendArguments:
        """Return the arguments of both blending passes; the tensors must outlive the call."""
        projected, options = self._projected, self.options
        lists = (projected.footprints, strip.tile_start, strip.instances, background)
        outputs = (*pixels, self._last, pair_counts)
        core_size = options.core_size if options.blending == "hybrid" else 0
        scalars = (projected.camera.projection, projected.camera.wrap, core_size, options.steepness)
        return abi.BlendArguments(strip.grid, *scalars, self.rays.native(), *map(pointer, (*lists, *outputs)))


rasterize, leave_one_out = _Image.rasterize, _Image.leave_one_out
