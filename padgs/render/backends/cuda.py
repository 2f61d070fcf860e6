"""The native GPU rasterizer (csrc/cuda), float32 only; bit-identical on a device: no atomic floats, stable sorts."""

from __future__ import annotations

import ctypes
import functools

import torch
from torch import Tensor

from padgs.native import cuda
from padgs.native.abi import GRADIENT_SUMS, REMOVAL, Gradients, Inputs, NativeCamera, pointer
from padgs.native.cuda import HostCopy, Queue, SortArguments, TileTable
from padgs.render.backends import native
from padgs.render.backends.native import TILE, NativeImage, Pixels, Strips, Upstream
from padgs.render.contract import LazyCounters, Removals

IDENTITY = torch.eye(4)
MAX_INSTANCES = (1 << 31) - 1 - 512  # of one strip: positions in its lists, and a batch behind, are 32-bit integers
HEADROOM = 1.3  # capacity for an image, as a multiple of the instances of the last image of this size
DECAY = 0.99  # of a capacity with each image that needs less; the faces of a cubemap need different ones in turn
_capacities: dict[tuple, int] = {}  # device, width and height -> capacity for the next image
FLOATS = functools.partial(torch.empty, dtype=torch.float32)
INTEGERS = functools.partial(torch.empty, dtype=torch.int32)


class DeviceStrip:
    """Tile lists of some rows of tiles, in the memory of a GPU."""

    def __init__(self, projected: DeviceProjected, first_row: int, end_row: int) -> None:
        device = projected.order.device
        self.tiles = (end_row - first_row) * -(-projected.camera.width // TILE)
        self.instances = projected.capacity if projected.capacity else sum(projected.per_row[first_row:end_row])
        if self.instances > MAX_INSTANCES:
            raise ValueError(
                f"one row of tiles has {self.instances:,} (Gaussian, tile) instances; a list holds at most "
                f"{MAX_INSTANCES:,}. Draw fewer or smaller Gaussians, or with backend=cpu"
            )
        integers = functools.partial(INTEGERS, device=device)
        self.slot_start = integers(projected.visible + 1)
        self.reaches = integers(self.instances, 2)
        self.slots = integers(self.instances)
        self.tile_start = integers(self.tiles + 1)
        self.table = projected.table(first_row, end_row)
        counts = integers(projected.visible + 1)
        sort = Sorter(projected.queue, self.instances, device, summed=len(counts))
        largest = self.tiles if projected.capacity else max(self.tiles - 1, 1)
        if projected.capacity:  # unused instances have a key behind that of the last tile
            sort.keys.fill_(largest)
            sort.values.zero_()
        arguments = cuda.BinArguments(
            self.table,
            *map(pointer, (projected.boxes, projected.order)),
            projected.visible,
            *map(pointer, (counts, self.slot_start, self.reaches)),
            sort.arguments(self.slots, bits=largest.bit_length()),
            pointer(self.tile_start),
        )
        cuda.call("padgs_cuda_bin", projected.queue, arguments, self.tiles)


class Sorter:
    """Keys, values and scratch memory of one stable sort, and of a sum."""

    def __init__(self, queue: Queue, count: int, device: torch.device, *, summed: int = 0) -> None:
        self.queue, self.count = queue, count
        self.keys = INTEGERS(count, device=device)
        self.sorted_keys, self.values = torch.empty_like(self.keys), torch.empty_like(self.keys)
        scratch = cuda.library().padgs_cuda_scratch_bytes(ctypes.byref(queue), max(count, summed, 1))
        cuda.raise_for(max(-scratch, 0), "padgs_cuda_scratch_bytes")
        self.scratch = torch.empty(max(scratch, 1), dtype=torch.uint8, device=device)

    def arguments(self, sorted_values: Tensor, bits: int) -> SortArguments:
        """Return the arguments for the library; the tensors must outlive the call."""
        buffers = (self.keys, self.sorted_keys, self.values, sorted_values)
        return SortArguments(pointer(self.scratch), len(self.scratch), self.count, *map(pointer, buffers), bits)


class DeviceProjected(Strips):
    """All Gaussians projected to one view, in depth order, with the number of instances in each row of tiles.

    The host reads one thing back: the number of instances in each row of tiles, before memory for them is allocated.
    """

    def __init__(
        self, camera: NativeCamera, pose: Tensor, inputs: Inputs, max_instances: int, *, capacity: int = 0
    ) -> None:
        """Project by `pose` [4, 4] on the device (that of the camera is not used), sort and count.

        With a capacity, the host does not wait: a single strip has room for so many instances, `counts` holds their
        number on the device, and invisible Gaussians are skipped instead of left out.
        """
        device, count = pose.device, inputs.count
        self.queue = cuda.queue(device)
        self.camera = camera
        rows = -(-camera.height // TILE)
        self.footprints = FLOATS(count, 16, device=device)
        self.boxes = INTEGERS(count, 5, device=device)
        self.order = INTEGERS(count, device=device)
        self.per_row: list[int] = []
        sort = Sorter(self.queue, count, device)
        self.counts = torch.zeros(rows + 1, dtype=torch.int64, device=device)
        outputs = (self.footprints, self.boxes, sort.keys, sort.values)
        lists = (*map(pointer, outputs), self.table(0, rows), pointer(self.counts))
        arguments = cuda.ProjectArguments(camera, pointer(pose), inputs, *lists)
        cuda.call("padgs_cuda_project", self.queue, arguments)
        cuda.call("padgs_cuda_sort", self.queue, sort.arguments(self.order, bits=32))
        self.capacity, self.visible = capacity, count
        cuts = [0, rows]
        if not capacity:
            *self.per_row, self.visible = self.counts.tolist()
            cuts = native.strip_cuts(self.per_row, min(max_instances, MAX_INSTANCES))
        super().__init__(DeviceStrip, cuts)

    def fits(self, counts: list[int]) -> bool:
        """Return whether the capacity was enough for all instances; `counts` are the values of `self.counts`."""
        *self.per_row, self.visible = counts
        return self.instances <= self.capacity

    @property
    def instances(self) -> int:
        """Return the number of instances of all rows; known after the host read it."""
        return sum(self.per_row)

    def table(self, first_row: int, end_row: int) -> TileTable:
        """Return some rows of tiles for the library."""
        return TileTable(self.camera.width, self.camera.height, first_row, end_row)


class _Image(NativeImage):
    @staticmethod
    def check(means: Tensor) -> None:
        if means.dtype != torch.float32 or means.device.type != cuda.device_type():
            missing = "" if torch.cuda.is_available() else " (torch finds no GPU with a driver here)"
            raise ValueError(
                f"backend cuda takes float32 tensors on a GPU, got {means.dtype} on {means.device}{missing}; convert "
                "them, or use backend=auto"
            )

    def draw(self, inputs: Inputs, pose: Tensor, background: Tensor, *, differentiated: bool) -> tuple[Pixels, Tensor]:
        camera, options, device = self.camera, self.options, pose.device
        self.rays = native.native_rays(camera, device)
        size = (camera.height, camera.width)
        transmittance, depth = FLOATS(2, *size, device=device)
        pixels = (FLOATS(*size, 3, device=device), transmittance, depth)
        hybrid = options.blending == "hybrid"
        self._core_size, keeps_core = options.core_size if hybrid else 0, hybrid and differentiated
        # Outputs of blending for the backward pass: position of the last contribution, or cores (csrc/cuda/core.h).
        self._last = None if hybrid else INTEGERS(size, device=device)
        self._core = INTEGERS((*size, self._core_size), device=device) if keeps_core else None
        self._tails = FLOATS(*size, 6, device=device) if keeps_core else None
        seen, key = native.native_camera(IDENTITY, camera, options), (device, camera.width, camera.height)
        limit = min(options.max_instances, MAX_INSTANCES)
        capacity = _capacities.get(key, 0)
        if not 0 < capacity <= limit:
            capacity = 0
        while True:
            self._projected = DeviceProjected(seen, pose, inputs, options.max_instances, capacity=capacity)
            counts = HostCopy(self._projected.counts) if capacity else None
            pairs = self._blend(background, pixels)
            if counts is None or self._projected.fits(counts.values()):
                break
            capacity = 0
        instances = self._projected.instances
        wanted = max(int(HEADROOM * instances) + 1, int(DECAY * capacity))
        _capacities[key] = min(wanted, limit) if instances <= limit else 0  # 0: strips need the exact number
        known = {"gaussians": inputs.count, "visible": self._projected.visible, "instances": instances}
        self.counters = LazyCounters(known, ("evaluated", "contributing"), pairs.tolist)
        return pixels, self._projected.boxes[:, 3] < self._projected.boxes[:, 4]

    def gradient_sums(self, pixels: Pixels, background: Tensor, upstream: Upstream) -> Tensor:
        projected, device, core_size = self._projected, background.device, self._core_size
        totals = torch.zeros(len(projected.order), GRADIENT_SUMS, dtype=torch.float32, device=device)
        core_gradients = FLOATS(*pixels[2].shape, core_size, 2, device=device) if core_size else None
        for strip in projected.strips():
            sums = FLOATS(min(strip.instances, projected.instances), GRADIENT_SUMS, device=device)
            arguments = cuda.BlendGradientInputs(
                self._blend_inputs(strip, background, pixels, None),
                *map(pointer, (upstream.image, upstream.transmittance, upstream.depth)),
                *map(pointer, (core_gradients, sums, upstream.rays, projected.order, strip.slot_start)),
                projected.visible,
                pointer(totals),
                upstream.absgrad,
            )
            cuda.call("padgs_cuda_blend_backward", projected.queue, arguments)
        return totals

    def removals(self, pixels: Pixels, background: Tensor, target: Tensor, weight: Tensor) -> Removals:
        projected, device = self._projected, background.device
        sums = torch.zeros(len(projected.order), REMOVAL - 1, dtype=torch.float64, device=device)
        peak = torch.zeros(len(projected.order), device=device)
        drawn = projected.order[: projected.visible].long()
        for strip in projected.strips():
            found = torch.zeros(strip.instances, REMOVAL, device=device)  # slots that no instance fills are read, too
            forward = self._blend_inputs(strip, background, pixels, None)
            arguments = cuda.RemovalInputs(forward, *map(pointer, (target, weight, found)))
            cuda.call("padgs_cuda_leave_one_out", projected.queue, arguments)
            starts = strip.slot_start[: projected.visible + 1].long()
            # Atomic additions would not be deterministic; a Gaussian is in `drawn` once.
            of_slots = functools.partial(torch.segment_reduce, offsets=starts, axis=0, initial=0, unsafe=True)
            sums[drawn] += of_slots(found[:, :-1].double(), "sum")
            peak[drawn] = torch.maximum(peak[drawn], of_slots(found[:, -1].contiguous(), "max"))
        error, change, contribution = sums.unbind(-1)
        return Removals(error, change, contribution, peak)

    def project_backward(
        self, inputs: Inputs, pose: Tensor, sums: Tensor, gradients: list[Tensor | None], *, needs_pose: bool
    ) -> Tensor | None:
        blocks = cuda.library().padgs_cuda_pose_blocks(inputs.count)
        pose_gradient = torch.empty(blocks, 12, dtype=torch.float64, device=pose.device) if needs_pose else None
        out = Gradients(*map(pointer, (*gradients, pose_gradient)))
        projected = self._projected
        arguments = cuda.ProjectGradientArguments(projected.camera, pointer(pose), inputs, pointer(sums), out)
        cuda.call("padgs_cuda_project_backward", projected.queue, arguments)
        return None if pose_gradient is None else pose_gradient.sum(0)

    def _blend(self, background: Tensor, pixels: Pixels) -> Tensor:
        """Fill the pixels; return how many pairs were evaluated, and how many contributed, [2] int64."""
        pairs = torch.zeros(2, dtype=torch.int64, device=background.device)
        for strip in self._projected.strips():
            pair_counts = INTEGERS(strip.tiles, 2, device=background.device)
            arguments = self._blend_inputs(strip, background, pixels, pair_counts)
            cuda.call("padgs_cuda_blend", self._projected.queue, arguments)
            pairs += pair_counts.sum(0)
        return pairs

    def _blend_inputs(
        self, strip: DeviceStrip, background: Tensor, pixels: Pixels, pair_counts: Tensor | None
    ) -> cuda.BlendInputs:
        """Return the arguments of both blending passes; the tensors must outlive the call."""
        projected = self._projected
        lists = (projected.footprints, strip.tile_start, strip.slots, strip.reaches, background)
        outputs = (*pixels, self._last, self._core, self._tails, pair_counts)
        scalars = (projected.camera.projection, projected.camera.wrap, self._core_size, projected.camera.steepness)
        return cuda.BlendInputs(strip.table, *scalars, self.rays.native(), *map(pointer, (*lists, *outputs)))


rasterize, leave_one_out = _Image.rasterize, _Image.leave_one_out
