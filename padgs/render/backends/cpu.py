"""The native CPU rasterizer: tiles, SIMD, OpenMP (csrc/cpu). float32 only.

Results do not depend on the number of threads: tiles write their own pixels, every (Gaussian, tile) instance has its
own slot for the moments of the backward pass, and the slots of a Gaussian are summed in order.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.native import cpu
from padgs.native.abi import (
    MOMENTS,
    REMOVAL,
    BlendArguments,
    BlendGradientArguments,
    Gradients,
    Inputs,
    LeaveOneOutArguments,
    pointer,
)
from padgs.render.backends.cpu_tiles import Projected, Strip
from padgs.render.backends.native import NativeImage, Pixels, Upstream, rasterize_as, score_as
from padgs.render.backends.native_camera import native_camera, native_rays
from padgs.render.contract import Removals, Rendering, Request
from padgs.render.published_bounds import check_memory


def rasterize(request: Request) -> Rendering:
    """Render on the CPU.

    Raises:
        ValueError: tensors that the library cannot take, or a projection that it does not know.
        OSError: the library was not built.
    """
    _check(request.gaussians.means)
    return rasterize_as(_Drawing(request), request)


def _check(means: Tensor) -> None:
    if means.dtype != torch.float32 or means.device.type != "cpu":
        raise ValueError(
            f"backend cpu takes float32 tensors on the CPU, got {means.dtype} on {means.device}; convert them, or use "
            "backend=torch"
        )


def leave_one_out(request: Request, target: Tensor, weight: Tensor) -> Removals:
    """Score on the CPU; sorted blending only.

    Raises:
        ValueError, OSError: as `rasterize` does.
    """
    _check(request.gaussians.means)
    return score_as(_Drawing(request), request, target, weight)


@dataclass
class _Cores:
    """What hybrid blending of a strip leaves to its backward pass, see csrc/cpu/kept_cores.h."""

    words: Tensor  # [most that could be needed] int32; the system lends memory for those that are used
    start: Tensor  # [tiles + 1] int64

    @staticmethod
    def of(strip: Strip, arguments: BlendArguments) -> _Cores:
        words = cpu.library().padgs_core_words(ctypes.byref(arguments))
        return _Cores(torch.empty(words, dtype=torch.int32), torch.zeros(strip.tiles + 1, dtype=torch.int64))

    def join(self, arguments: BlendArguments) -> None:
        arguments.cores, arguments.core_start = pointer(self.words), pointer(self.start)


class _Drawing(NativeImage):
    def draw(self, inputs: Inputs, pose: Tensor, background: Tensor, *, differentiated: bool) -> tuple[Pixels, Tensor]:
        camera, options = self.camera, self.options
        self._projected = Projected(native_camera(pose, camera, options), inputs, options.max_instances)
        check_memory(self._projected.instances, options)
        self.rays = native_rays(camera)
        size = (camera.height, camera.width)
        pixels = (torch.empty(*size, 3), torch.empty(size), torch.empty(size))
        self._last = torch.empty(size, dtype=torch.int32)  # where each pixel's last contribution is
        pairs = torch.zeros(2, dtype=torch.int64)
        self._cores: list[_Cores] = []  # of each strip where they are kept
        for strip in self._projected.strips():
            pair_counts = torch.empty(strip.tiles, 2, dtype=torch.int64)
            arguments = self._blend_arguments(strip, background, pixels, pair_counts)
            if differentiated and options.blending == "hybrid":
                self._cores.append(_Cores.of(strip, arguments))
                self._cores[-1].join(arguments)
            cpu.library().padgs_blend_forward(ctypes.byref(arguments))
            pairs += pair_counts.sum(0)
        self.counters = {
            "gaussians": inputs.count,
            "visible": self._projected.visible,
            "instances": self._projected.instances,
            "evaluated": int(pairs[0]),
            "contributing": int(pairs[1]),
        }
        visible = self._projected.boxes[:, 3] < self._projected.boxes[:, 4]
        return pixels, visible

    def moments(self, pixels: Pixels, background: Tensor, upstream: Upstream) -> Tensor:
        count = len(self._projected.boxes)
        totals = torch.zeros(count, MOMENTS)
        for number, strip in enumerate(self._projected.strips()):
            forward = self._blend_arguments(strip, background, pixels, None)
            if self._cores:
                self._cores[number].join(forward)
            moments = torch.empty(len(strip.instances), MOMENTS)
            grads = (upstream.image, upstream.transmittance, upstream.depth, moments, upstream.rays)
            arguments = BlendGradientArguments(forward, *map(pointer, grads), upstream.absolute)
            cpu.library().padgs_blend_backward(ctypes.byref(arguments))
            cpu.library().padgs_sum_moments(pointer(moments), pointer(strip.slot_start), count, pointer(totals))
        return totals

    def removals(self, pixels: Pixels, background: Tensor, target: Tensor, weight: Tensor) -> Removals:
        count = len(self._projected.boxes)
        sums, peak = torch.zeros(count, REMOVAL - 1, dtype=torch.float64), torch.zeros(count)
        for strip in self._projected.strips():
            forward = self._blend_arguments(strip, background, pixels, None)
            found = torch.empty(len(strip.instances), REMOVAL)
            arguments = LeaveOneOutArguments(forward, *map(pointer, (target, weight, found)))
            cpu.library().padgs_leave_one_out(ctypes.byref(arguments))
            owner = torch.repeat_interleave(torch.arange(count), strip.slot_start.diff())
            sums.index_add_(0, owner, found[:, :-1].double())
            peak.scatter_reduce_(0, owner, found[:, -1], "amax")
        error, change, contribution = sums.unbind(-1)
        return Removals(error, change, contribution, peak)

    def project_backward(
        self, inputs: Inputs, pose: Tensor, moments: Tensor, gradients: list[Tensor | None], *, needs_pose: bool
    ) -> Tensor | None:
        of_pose = torch.zeros(12, dtype=torch.float64) if needs_pose else None
        cpu.library().padgs_project_backward(
            ctypes.byref(self._projected.camera),
            ctypes.byref(inputs),
            pointer(moments),
            ctypes.byref(Gradients(*map(pointer, (*gradients, of_pose)))),
        )
        return of_pose

    def _blend_arguments(
        self, strip: Strip, background: Tensor, pixels: Pixels, pair_counts: Tensor | None
    ) -> BlendArguments:
        """Of both blending passes; the tensors must outlive the call."""
        projected, options = self._projected, self.options
        lists = (projected.footprints, strip.tile_start, strip.instances, background)
        outputs = (*pixels, self._last, pair_counts)
        core_size = options.core_size if options.blending == "hybrid" else 0
        scalars = (projected.camera.projection, projected.camera.wrap, core_size)
        return BlendArguments(strip.grid, *scalars, self.rays.native(), *map(pointer, (*lists, *outputs)))
