"""The native GPU rasterizer (csrc/cuda/), wrapped as one `torch.autograd.Function`. float32 only.

The same results, bit by bit, from the same device and build: no float is added atomically, and sorts are stable.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from padgs.gaussians import Gaussians
from padgs.native import cuda
from padgs.native.abi import Gradients, Inputs, pointer
from padgs.render.backends.cuda_tiles import DeviceProjected, DeviceStrip
from padgs.render.backends.native_camera import NativeRays, native_camera, native_rays
from padgs.render.contract import Rendering, RenderOptions
from padgs.render.published_bounds import check_memory
from padgs.render.tiles import ABSOLUTE_MOMENT, MOMENTS
from padgs.sphere.camera import Camera, RayTable

IDENTITY = torch.eye(4)


def rasterize(
    gaussians: Gaussians,
    cam_from_world: Tensor,
    camera: Camera,
    options: RenderOptions,
    background: Tensor,
    probe: Tensor | None = None,
    absolute_probe: Tensor | None = None,
) -> Rendering:
    """Render on the GPU that holds the tensors; arguments are those of `torch_backend.rasterize`.

    Raises:
        ValueError: tensors, or options, that the library cannot take.
        OSError: the library was not built.
        RuntimeError: the library was not compiled for this GPU.
        torch.cuda.OutOfMemoryError: the GPU has too little memory; `options.max_instances` makes the strips smaller.
    """
    check(gaussians.means)
    counters = Counters()
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


class Counters(Mapping[str, int]):
    """How many of what. Pairs are added up on the device and read, which waits for it, when somebody asks."""

    def __init__(self) -> None:
        """Nothing is known yet."""
        self._known: dict[str, int] = {}
        self._pairs: Tensor | None = None  # [2] evaluated and contributing

    def record(self, pairs: Tensor, **known: int) -> None:
        """What one rendering counted."""
        self._known, self._pairs = known, pairs

    def __getitem__(self, name: str) -> int:
        """The count of that name."""
        if self._pairs is not None:
            evaluated, contributing = self._pairs.tolist()
            self._known |= {"evaluated": evaluated, "contributing": contributing}
            self._pairs = None
        return self._known[name]

    def __iter__(self) -> Iterator[str]:
        """The names."""
        return iter(("gaussians", "visible", "instances", "evaluated", "contributing"))

    def __len__(self) -> int:
        """How many there are."""
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
        transmittance, depth = torch.empty(2, *size, device=device)
        integers = functools.partial(torch.empty, dtype=torch.int32, device=device)
        return Outputs(
            torch.empty(*size, 3, device=device),
            transmittance,
            depth,
            None if hybrid else integers(size),
            core_size,
            integers((*size, core_size)) if kept else None,
            torch.empty(*size, 6, device=device) if kept else None,
        )


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
        counters: Counters,
        grad_enabled: bool,
    ):
        device, count = means.device, len(means)
        tensors = [t.detach().contiguous() for t in (means, quats, scales, opacities, colors)]
        probe = None if probe is None else probe.detach().contiguous()
        pose, background = cam_from_world.detach().contiguous(), background.detach().contiguous()
        inputs = Inputs(count, *map(pointer, tensors), pointer(probe))
        projected = DeviceProjected(native_camera(IDENTITY, camera, options), pose, inputs, options.max_instances)
        check_memory(projected.instances, options)
        rays = native_rays(camera, device)
        outputs = Outputs.of(camera, options, device, differentiated=grad_enabled and any(ctx.needs_input_grad))
        pairs = blend(projected, rays, background, outputs)
        visible = projected.boxes[:, 3] < projected.boxes[:, 4]
        counters.record(pairs, gaussians=count, visible=projected.visible, instances=projected.instances)
        ctx.mark_non_differentiable(visible)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*tensors, cam_from_world, background, outputs.image, outputs.transmittance, outputs.depth)
        ctx.probe, ctx.projected, ctx.rays = probe, projected, rays
        ctx.kept = (outputs.last, outputs.core_size, outputs.core, outputs.tails)
        return outputs.image, outputs.transmittance, outputs.depth, visible

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_transmittance, grad_depth, _):
        *tensors, cam_from_world, background, image, transmittance, depth = ctx.saved_tensors
        projected, outputs = ctx.projected, Outputs(image, transmittance, depth, *ctx.kept)
        grad_image = torch.zeros_like(image) if grad_image is None else grad_image.contiguous()
        upstream = [grad_image, *(g if g is None else g.contiguous() for g in (grad_transmittance, grad_depth))]
        needs_absolute, needs_pose, needs_background, needs_rays = ctx.needs_input_grad[6:10]
        grad_rays = torch.zeros_like(ctx.rays.table) if needs_rays else None
        totals = _moments(projected, ctx.rays, background, outputs, upstream, grad_rays, absolute=needs_absolute)

        count, device = len(tensors[0]), image.device
        gradients = [torch.empty_like(t) for t in tensors]
        probe = None if ctx.probe is None else torch.empty_like(ctx.probe)
        blocks = cuda.library().padgs_cuda_pose_blocks(count)
        poses = torch.empty(blocks, 12, dtype=torch.float64, device=device) if needs_pose else None
        arguments = cuda.ProjectGradientArguments(
            projected.camera,
            pointer(cam_from_world.contiguous()),
            Inputs(count, *map(pointer, tensors), pointer(ctx.probe)),
            pointer(totals),
            Gradients(*map(pointer, gradients), pointer(probe), pointer(poses)),
        )
        cuda.call("padgs_cuda_project_backward", projected.queue, arguments)
        grad_pose = grad_background = grad_table = None
        if poses is not None:
            grad_pose = torch.zeros_like(cam_from_world)
            grad_pose[:3] = poses.sum(0).view(3, 4).to(grad_pose.dtype)
        if needs_background:
            grad_background = (grad_image * transmittance[..., None]).sum((0, 1))
        if grad_rays is not None:
            grad_table = grad_rays[:, :, : image.shape[1]].permute(0, 2, 1)
        absolute = totals[:, ABSOLUTE_MOMENT].clone() if needs_absolute else None
        return *gradients, probe, absolute, grad_pose, grad_background, grad_table, None, None, None, None


def blend(projected: DeviceProjected, rays: NativeRays, background: Tensor, outputs: Outputs) -> Tensor:
    """Fill the outputs; returns how many pairs were evaluated, and how many contributed, [2] int64."""
    pairs = torch.zeros(2, dtype=torch.int64, device=background.device)
    for strip in projected.strips():
        pair_counts = torch.empty(strip.chunks, 2, dtype=torch.int32, device=background.device)
        arguments = _blend_inputs(projected, strip, rays, background, outputs, pair_counts)
        cuda.call("padgs_cuda_blend", projected.queue, arguments)
        pairs += pair_counts.sum(0)
    return pairs


def _moments(
    projected: DeviceProjected,
    rays: Any,
    background: Tensor,
    outputs: Outputs,
    upstream: list[Tensor | None],
    grad_rays: Tensor | None,
    *,
    absolute: bool,
) -> Tensor:
    """Moments [N, MOMENTS] of all Gaussians, from the gradients of image, transmittance and depth."""
    device, size, hybrid = background.device, outputs.depth.shape, outputs.core_size > 0
    totals = torch.zeros(len(projected.order), MOMENTS, device=device)
    packed = torch.empty(*size, 4, device=device)
    core_gradients = torch.empty(*size, outputs.core_size, 2, device=device) if hybrid else None
    tail_gradients = torch.empty(*size, 4, device=device) if hybrid else None
    for strip in projected.strips():
        states = None if hybrid else projected.states(strip)
        furthest = None if hybrid else torch.empty(strip.chunks, dtype=torch.int32, device=device)
        moments = torch.empty(strip.instances, MOMENTS, device=device)
        arguments = cuda.BlendGradientInputs(
            _blend_inputs(projected, strip, rays, background, outputs, None),
            *map(pointer, upstream),
            *map(pointer, (packed, states, furthest, core_gradients, tail_gradients)),
            strip.instances,
            *map(pointer, (moments, grad_rays, projected.order, strip.slot_start)),
            projected.visible,
            pointer(totals),
            absolute,
        )
        cuda.call("padgs_cuda_blend_backward", projected.queue, arguments, strip.tiles)
    return totals


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
