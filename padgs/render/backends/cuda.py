"""The native GPU rasterizer (csrc/cuda). float32 only.

The same results, bit by bit, from the same device and build: no float is added atomically, and sorts are stable.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from padgs.geometry.camera import Camera
from padgs.native import cuda
from padgs.native.abi import MOMENTS, REMOVAL, Gradients, Inputs, pointer
from padgs.native.reading import Reading
from padgs.render.backends.cuda_tiles import MAX_INSTANCES, DeviceProjected, DeviceStrip
from padgs.render.backends.native import NativeImage, Pixels, Upstream, rasterize_as, score_as
from padgs.render.backends.native_camera import NativeRays, native_camera, native_rays
from padgs.render.contract import Removals, Rendering, RenderOptions, Request
from padgs.render.published_bounds import check_memory

IDENTITY = torch.eye(4)
HEADROOM = 1.3  # room for so many times the instances of the last image of this size
_rooms: dict[tuple, int] = {}  # device, width and height -> room for the next
FLOATS = functools.partial(torch.empty, dtype=torch.float32)
INTEGERS = functools.partial(torch.empty, dtype=torch.int32)


def rasterize(request: Request) -> Rendering:
    """Render on the GPU that holds the tensors.

    Raises:
        ValueError: tensors, or options, that the library cannot take.
        OSError: the library was not built.
        RuntimeError: the library was not compiled for this GPU.
        torch.cuda.OutOfMemoryError: the GPU has too little memory; `options.max_instances` makes the strips smaller.
    """
    check(request.gaussians.means)
    return rasterize_as(_Drawing(request), request)


def check(means: Tensor) -> None:
    """Refuse what the library cannot draw, and say what can.

    Raises:
        ValueError, OSError: as `rasterize` does.
    """
    if means.dtype != torch.float32 or means.device.type != cuda.device_type():
        missing = "" if torch.cuda.is_available() else " (torch finds no GPU with a driver here)"
        raise ValueError(
            f"backend cuda takes float32 tensors on a GPU, got {means.dtype} on {means.device}{missing}; convert them, "
            "or use backend=auto"
        )


def leave_one_out(request: Request, target: Tensor, weight: Tensor) -> Removals:
    """Score on the GPU that holds the tensors; sorted blending only.

    Raises:
        ValueError, OSError, RuntimeError: as `rasterize` does.
    """
    check(request.gaussians.means)
    return score_as(_Drawing(request), request, target, weight)


class Counters(Mapping[str, int]):
    """How many of what. Pairs are added up on the device and read, which waits for it, when somebody asks."""

    def __init__(self, pairs: Tensor, **known: int) -> None:
        self._known = known
        self._pairs: Tensor | None = pairs  # [2] evaluated and contributing

    def __getitem__(self, name: str) -> int:
        if self._pairs is not None:
            evaluated, contributing = self._pairs.tolist()
            self._known |= {"evaluated": evaluated, "contributing": contributing}
            self._pairs = None
        return self._known[name]

    def __iter__(self) -> Iterator[str]:
        return iter(("gaussians", "visible", "instances", "evaluated", "contributing"))

    def __len__(self) -> int:
        return 5


@dataclass
class Outputs:
    """What blending writes, and needs again to go back."""

    image: Tensor  # [H, W, 3]
    transmittance: Tensor  # [H, W]
    depth: Tensor  # [H, W]
    last: Tensor | None  # [H, W] int32, sorted blending: where each pixel's last contribution is
    core_size: int  # of hybrid blending, or 0
    core: Tensor | None  # [H, W, core_size] int32, hybrid blending that is to be differentiated: see csrc/cuda/core.h
    tails: Tensor | None  # [H, W, 6], as core

    @staticmethod
    def of(camera: Camera, options: RenderOptions, device: torch.device, *, differentiated: bool = False) -> Outputs:
        """Room for one image."""
        size, hybrid = (camera.height, camera.width), options.blending == "hybrid"
        core_size = options.core_size if hybrid else 0
        kept = hybrid and differentiated
        transmittance, depth = FLOATS(2, *size, device=device)
        return Outputs(
            FLOATS(*size, 3, device=device),
            transmittance,
            depth,
            None if hybrid else INTEGERS(size, device=device),
            core_size,
            INTEGERS((*size, core_size), device=device) if kept else None,
            FLOATS(*size, 6, device=device) if kept else None,
        )


class _Drawing(NativeImage):
    def draw(self, inputs: Inputs, pose: Tensor, background: Tensor, *, differentiated: bool) -> tuple[Pixels, Tensor]:
        camera, options, device = self.camera, self.options, pose.device
        self.rays = native_rays(camera, device)
        outputs = Outputs.of(camera, options, device, differentiated=differentiated)
        native, alike = native_camera(IDENTITY, camera, options), (device, camera.width, camera.height)
        limit = min(options.max_instances, MAX_INSTANCES)
        room = _rooms.get(alike, 0) if options.memory_cap is None else 0
        if not 0 < room <= limit:
            room = 0
        while True:
            self._projected = DeviceProjected(native, pose, inputs, options.max_instances, room=room)
            counts = Reading(self._projected.counts) if room else None
            if counts is None:
                check_memory(self._projected.instances, options)
            pairs = blend(self._projected, self.rays, background, outputs)
            if counts is None or self._projected.fits(counts.values()):
                break
            room = 0
        instances = self._projected.instances
        wanted = max(int(HEADROOM * instances) + 1, room * 15 // 16)
        _rooms[alike] = min(wanted, limit) if instances <= limit else 0  # 0: strips, which count as they go
        self._kept = (outputs.last, outputs.core_size, outputs.core, outputs.tails)
        known = {"visible": self._projected.visible, "instances": self._projected.instances}
        self.counters = Counters(pairs, gaussians=inputs.count, **known)
        visible = self._projected.boxes[:, 3] < self._projected.boxes[:, 4]
        return (outputs.image, outputs.transmittance, outputs.depth), visible

    def moments(self, pixels: Pixels, background: Tensor, upstream: Upstream) -> Tensor:
        projected, outputs = self._projected, Outputs(*pixels, *self._kept)
        device, size, hybrid = background.device, outputs.depth.shape, outputs.core_size > 0
        totals = torch.zeros(len(projected.order), MOMENTS, dtype=torch.float32, device=device)
        core_gradients = FLOATS(*size, outputs.core_size, 2, device=device) if hybrid else None
        for strip in projected.strips():
            moments = FLOATS(strip.instances, MOMENTS, device=device)
            arguments = cuda.BlendGradientInputs(
                _blend_inputs(projected, strip, self.rays, background, outputs, None),
                *map(pointer, (upstream.image, upstream.transmittance, upstream.depth)),
                *map(pointer, (core_gradients, moments, upstream.rays, projected.order, strip.slot_start)),
                projected.visible,
                pointer(totals),
                upstream.absolute,
            )
            cuda.call("padgs_cuda_blend_backward", projected.queue, arguments)
        return totals

    def removals(self, pixels: Pixels, background: Tensor, target: Tensor, weight: Tensor) -> Removals:
        projected, outputs, device = self._projected, Outputs(*pixels, *self._kept), background.device
        sums = torch.zeros(len(projected.order), REMOVAL - 1, dtype=torch.float64, device=device)
        peak = torch.zeros(len(projected.order), device=device)
        drawn = projected.order[: projected.visible].long()
        for strip in projected.strips():
            found = torch.zeros(strip.instances, REMOVAL, device=device)  # what no instance fills is read, too
            forward = _blend_inputs(projected, strip, self.rays, background, outputs, None)
            arguments = cuda.RemovalInputs(forward, *map(pointer, (target, weight, found)))
            cuda.call("padgs_cuda_leave_one_out", projected.queue, arguments)
            starts = strip.slot_start[: projected.visible + 1].long()
            # Not by atomic additions, whose order differs from time to time; a Gaussian is in `drawn` once.
            of_slots = functools.partial(torch.segment_reduce, offsets=starts, axis=0, initial=0, unsafe=True)
            sums[drawn] += of_slots(found[:, :-1].double(), "sum")
            peak[drawn] = torch.maximum(peak[drawn], of_slots(found[:, -1].contiguous(), "max"))
        error, change, contribution = sums.unbind(-1)
        return Removals(error, change, contribution, peak)

    def project_backward(
        self, inputs: Inputs, pose: Tensor, moments: Tensor, gradients: list[Tensor | None], *, needs_pose: bool
    ) -> Tensor | None:
        blocks = cuda.library().padgs_cuda_pose_blocks(inputs.count)
        of_pose = torch.empty(blocks, 12, dtype=torch.float64, device=pose.device) if needs_pose else None
        out = Gradients(*map(pointer, (*gradients, of_pose)))
        projected = self._projected
        arguments = cuda.ProjectGradientArguments(projected.camera, pointer(pose), inputs, pointer(moments), out)
        cuda.call("padgs_cuda_project_backward", projected.queue, arguments)
        return None if of_pose is None else of_pose.sum(0)


def blend(projected: DeviceProjected, rays: NativeRays, background: Tensor, outputs: Outputs) -> Tensor:
    """Fill the outputs; returns how many pairs were evaluated, and how many contributed, [2] int64."""
    pairs = torch.zeros(2, dtype=torch.int64, device=background.device)
    for strip in projected.strips():
        pair_counts = INTEGERS(strip.tiles, 2, device=background.device)
        arguments = _blend_inputs(projected, strip, rays, background, outputs, pair_counts)
        cuda.call("padgs_cuda_blend", projected.queue, arguments)
        pairs += pair_counts.sum(0)
    return pairs


def _blend_inputs(
    projected: DeviceProjected, strip: DeviceStrip, rays: Any, background: Tensor, outputs: Outputs, pair_counts
) -> cuda.BlendInputs:
    """Arguments of both directions; the tensors must outlive the call."""
    camera = projected.camera
    lists = (projected.footprints, strip.tile_start, strip.slots, strip.reaches, background)
    written = (outputs.image, outputs.transmittance, outputs.depth, outputs.last, outputs.core, outputs.tails)
    return cuda.BlendInputs(
        strip.table,
        camera.projection,
        camera.wrap,
        outputs.core_size,
        rays.native(),
        *map(pointer, (*lists, *written, pair_counts)),
    )
