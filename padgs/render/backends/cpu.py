"""The native CPU rasterizer: tiles, SIMD, OpenMP (csrc/), wrapped as one `torch.autograd.Function`. float32 only.

Results do not depend on the number of threads: tiles write their own pixels, every (Gaussian, tile) instance has its
own slot for the moments of the backward pass, and the slots of a Gaussian are summed in order.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from padgs.gaussians import Gaussians
from padgs.native import cpu
from padgs.native.abi import BlendArguments, BlendGradientArguments, Gradients, Inputs, pointer
from padgs.render.backends.native_camera import native_camera, native_rays
from padgs.render.contract import Rendering, RenderOptions
from padgs.render.published_bounds import check_memory
from padgs.render.tiles import ABSOLUTE_MOMENT, MOMENTS, Projected, Strip
from padgs.sphere.camera import Camera, RayTable


def rasterize(
    gaussians: Gaussians,
    cam_from_world: Tensor,
    camera: Camera,
    options: RenderOptions,
    background: Tensor,
    probe: Tensor | None = None,
    absolute_probe: Tensor | None = None,
) -> Rendering:
    """Render with the native library; arguments are those of `torch_backend.rasterize`.

    Raises:
        ValueError: tensors that the library cannot take, or a projection that it does not know.
        OSError: the library was not built.
    """
    if gaussians.means.dtype != torch.float32 or gaussians.means.device.type != "cpu":
        raise ValueError(
            f"backend cpu takes float32 tensors on the CPU, got {gaussians.means.dtype} on {gaussians.means.device}; "
            "convert them, or use backend=torch"
        )
    counters: dict[str, int] = {}
    image, transmittance, depth, visible = _Rasterize.apply(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.colors,
        probe,
        absolute_probe,
        cam_from_world,
        background,
        camera.table if isinstance(camera, RayTable) else None,
        camera,
        options,
        counters,
        torch.is_grad_enabled(),  # never inside
    )
    return Rendering(image, transmittance, depth, visible, counters)


@dataclass
class _Buffers:
    """What blending writes, and needs again to go back."""

    image: Tensor  # [H, W, 3]
    transmittance: Tensor  # [H, W]
    depth: Tensor  # [H, W]
    last: Tensor  # [H, W] int32

    @staticmethod
    def of_size(width: int, height: int) -> _Buffers:
        flat = torch.empty(height, width)
        return _Buffers(torch.empty(height, width, 3), flat, torch.empty_like(flat), flat.to(torch.int32))


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


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        probe: Tensor | None,
        _absolute_probe: Tensor | None,
        cam_from_world: Tensor,
        background: Tensor,
        _table: Tensor | None,
        camera: Camera,
        options: RenderOptions,
        counters: dict[str, int],
        grad_enabled: bool,
    ):
        tensors = [t.detach().contiguous() for t in (means, quats, scales, opacities, colors)]
        probe = None if probe is None else probe.detach().contiguous()
        inputs = Inputs(len(means), *map(pointer, tensors), pointer(probe))
        native_cam = native_camera(cam_from_world, camera, options)
        projected = Projected(native_cam, inputs, options.max_instances)
        check_memory(projected.instances, options)
        rays, background = native_rays(camera), background.detach().contiguous()
        buffers = _Buffers.of_size(camera.width, camera.height)
        pairs = torch.zeros(2, dtype=torch.int64)
        kept = options.blending == "hybrid" and grad_enabled and any(ctx.needs_input_grad)
        ctx.cores = []  # of each strip where they are kept
        for strip in projected.strips():
            pair_counts = torch.empty(strip.tiles, 2, dtype=torch.int64)
            arguments = _blend_arguments(native_cam, options, projected, strip, rays, background, buffers, pair_counts)
            if kept:
                ctx.cores.append(_Cores.of(strip, arguments))
                ctx.cores[-1].join(arguments)
            cpu.library().padgs_blend_forward(ctypes.byref(arguments))
            pairs += pair_counts.sum(0)
        visible = projected.boxes[:, 3] < projected.boxes[:, 4]
        counters.update(
            gaussians=len(means),
            visible=projected.visible,
            instances=projected.instances,
            evaluated=int(pairs[0]),
            contributing=int(pairs[1]),
        )
        ctx.mark_non_differentiable(visible)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*tensors, cam_from_world, background, buffers.image, buffers.transmittance, buffers.depth)
        ctx.last, ctx.probe, ctx.projected, ctx.native_cam, ctx.rays = buffers.last, probe, projected, native_cam, rays
        ctx.options = options
        return buffers.image, buffers.transmittance, buffers.depth, visible

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_transmittance, grad_depth, _):
        *tensors, cam_from_world, background, image, transmittance, depth = ctx.saved_tensors
        buffers, projected = _Buffers(image, transmittance, depth, ctx.last), ctx.projected
        grad_image = torch.zeros_like(image) if grad_image is None else grad_image.contiguous()
        upstream = [grad_image, *(g if g is None else g.contiguous() for g in (grad_transmittance, grad_depth))]
        needs_absolute, needs_pose, needs_background, needs_rays = ctx.needs_input_grad[6:10]
        grad_rays = torch.zeros_like(ctx.rays.table) if needs_rays else None
        count = len(tensors[0])
        totals = torch.zeros(count, MOMENTS)
        for number, strip in enumerate(projected.strips()):
            forward = _blend_arguments(
                ctx.native_cam, ctx.options, projected, strip, ctx.rays, background, buffers, None
            )
            if ctx.cores:
                ctx.cores[number].join(forward)
            moments = torch.empty(len(strip.instances), MOMENTS)
            arguments = BlendGradientArguments(
                forward, *map(pointer, upstream), pointer(moments), pointer(grad_rays), needs_absolute
            )
            cpu.library().padgs_blend_backward(ctypes.byref(arguments))
            cpu.library().padgs_sum_moments(pointer(moments), pointer(strip.slot_start), count, pointer(totals))
        outputs = [torch.empty_like(t) for t in tensors]
        probe = None if ctx.probe is None else torch.empty_like(ctx.probe)
        pose = torch.zeros(12, dtype=torch.float64) if needs_pose else None
        inputs = Inputs(count, *map(pointer, tensors), pointer(ctx.probe))
        cpu.library().padgs_project_backward(
            ctypes.byref(ctx.native_cam),
            ctypes.byref(inputs),
            pointer(totals),
            ctypes.byref(Gradients(*map(pointer, outputs), pointer(probe), pointer(pose))),
        )
        grad_pose = grad_background = grad_table = None
        if pose is not None:
            grad_pose = torch.zeros_like(cam_from_world)
            grad_pose[:3] = pose.view(3, 4).to(grad_pose.dtype)
        if needs_background:
            grad_background = (grad_image * transmittance[..., None]).sum((0, 1))
        if grad_rays is not None:
            grad_table = grad_rays[:, :, : image.shape[1]].permute(0, 2, 1)
        absolute = totals[:, ABSOLUTE_MOMENT].clone() if needs_absolute else None
        return *outputs, probe, absolute, grad_pose, grad_background, grad_table, None, None, None, None


def _blend_arguments(camera, options, projected, strip, rays, background, buffers, pair_counts) -> BlendArguments:
    """Arguments of both blending passes; the tensors must outlive the call."""
    lists = (projected.footprints, strip.tile_start, strip.instances, background)
    outputs = (buffers.image, buffers.transmittance, buffers.depth, buffers.last, pair_counts)
    core_size = options.core_size if options.blending == "hybrid" else 0
    return BlendArguments(
        strip.grid, camera.projection, camera.wrap, core_size, rays.native(), *map(pointer, (*lists, *outputs))
    )
