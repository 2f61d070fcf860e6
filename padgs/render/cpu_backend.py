"""The native CPU rasterizer: tiles, SIMD, OpenMP (csrc/), wrapped as one `torch.autograd.Function`. float32 only.

Results do not depend on the number of threads: tiles write their own pixels, every (Gaussian, tile) instance has its
own slot for the moments of the backward pass, and the slots of a Gaussian are summed in order.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from padgs.gaussians import Gaussians
from padgs.render import native
from padgs.render.contract import Rendering, RenderOptions
from padgs.render.native import pointer

TILE = 16
MOMENTS = 10


def rasterize(
    gaussians: Gaussians,
    cam_from_world: Tensor,
    width: int,
    height: int,
    options: RenderOptions,
    background: Tensor,
    probe: Tensor | None = None,
) -> Rendering:
    """Render with the native library; arguments are those of `padgs.render.render`, checked.

    Raises:
        ValueError: tensors that the library cannot take, or a projection that it does not know.
        OSError: the library was not built.
    """
    if gaussians.means.dtype != torch.float32 or gaussians.means.device.type != "cpu":
        raise ValueError(
            f"backend cpu takes float32 tensors on the CPU, got {gaussians.means.dtype} on {gaussians.means.device}; "
            "convert them, or use backend=torch"
        )
    if options.projection != "erp":
        raise ValueError(f"backend cpu does not know projection {options.projection!r}; known: erp")
    counters: dict[str, int] = {}
    image, transmittance, depth, visible = _Rasterize.apply(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.colors,
        probe,
        cam_from_world,
        background,
        (width, height, options),
        counters,
    )
    return Rendering(image, transmittance, depth, visible, counters)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means, quats, scales, opacities, colors, probe, cam_from_world, background, size, counters):
        width, height, options = size
        tensors = [t.contiguous() for t in (means, quats, scales, opacities, colors)]
        probe = None if probe is None else probe.contiguous()
        camera = _camera(cam_from_world, width, height, options)
        inputs = native.Inputs(len(means), *map(pointer, tensors), pointer(probe))
        tiles = _Tiles(camera, inputs)
        background = background.contiguous()
        image = means.new_empty(height, width, 3)
        transmittance, depth = means.new_empty(height, width), means.new_empty(height, width)
        last = torch.empty(height, width, dtype=torch.int32)
        pair_counts = torch.empty(tiles.count, 2, dtype=torch.int64)
        blend = tiles.blend_arguments(background, image, transmittance, depth, last, pair_counts)
        native.library().padgs_blend_forward(ctypes.byref(blend))
        visible = tiles.boxes[:, 0] < tiles.boxes[:, 1]
        evaluated, contributing = pair_counts.sum(0).tolist()
        counters.update(
            gaussians=len(means),
            visible=tiles.visible,
            instances=len(tiles.instances),
            evaluated=evaluated,
            contributing=contributing,
        )
        ctx.mark_non_differentiable(visible)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*tensors, cam_from_world, background, image, transmittance, depth)
        ctx.probe, ctx.tiles, ctx.last, ctx.camera, ctx.pair_counts = probe, tiles, last, camera, pair_counts
        return image, transmittance, depth, visible

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image, grad_transmittance, grad_depth, _):
        *tensors, cam_from_world, background, image, transmittance, depth = ctx.saved_tensors
        tiles: _Tiles = ctx.tiles
        if grad_image is None:
            grad_image = torch.zeros_like(image)
        grads = [g if g is None else g.contiguous() for g in (grad_image, grad_transmittance, grad_depth)]
        moments = torch.empty(len(tiles.instances), MOMENTS)
        forward = tiles.blend_arguments(background, image, transmittance, depth, ctx.last, ctx.pair_counts)
        arguments = native.BlendGradientArguments(forward, *map(pointer, grads), pointer(moments))
        native.library().padgs_blend_backward(ctypes.byref(arguments))
        outputs = [torch.zeros_like(t) for t in tensors]
        probe = None if ctx.probe is None else torch.zeros_like(ctx.probe)
        pose = torch.zeros(12, dtype=torch.float64) if ctx.needs_input_grad[6] else None
        inputs = native.Inputs(len(tensors[0]), *map(pointer, tensors), pointer(ctx.probe))
        native.library().padgs_project_backward(
            ctypes.byref(ctx.camera),
            ctypes.byref(inputs),
            pointer(tiles.slot_start),
            pointer(moments),
            ctypes.byref(native.Gradients(*map(pointer, outputs), pointer(probe), pointer(pose))),
        )
        grad_pose = None
        if pose is not None:
            grad_pose = torch.zeros_like(cam_from_world)
            grad_pose[:3] = pose.view(3, 4).to(grad_pose.dtype)
        grad_background = None
        if ctx.needs_input_grad[7]:
            grad_background = (grad_image * transmittance[..., None]).sum((0, 1))
        return *outputs, probe, grad_pose, grad_background, None, None


def _camera(cam_from_world: Tensor, width: int, height: int, options: RenderOptions) -> native.Camera:
    pose = (ctypes.c_float * 12)(*cam_from_world[:3].detach().reshape(-1).tolist())
    square = options.bounds == "square"
    return native.Camera(width, height, pose, options.near, options.low_pass, options.wrap, square)


class _Tiles:
    """Projected Gaussians, and for each tile the list of those that touch it, front to back."""

    def __init__(self, camera: native.Camera, inputs: native.Inputs) -> None:
        library = native.library()
        self.camera, count = camera, inputs.count
        columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
        self.rows, self.count = rows, rows * columns
        self.footprints = torch.empty(count, 12)
        self.boxes = torch.empty(count, 5, dtype=torch.int32)
        library.padgs_project(ctypes.byref(camera), ctypes.byref(inputs), pointer(self.footprints), pointer(self.boxes))
        order = torch.empty(count, dtype=torch.int32)
        self.visible = library.padgs_depth_order(pointer(self.footprints), pointer(self.boxes), count, pointer(order))
        per_row = torch.empty(rows, dtype=torch.int64)
        library.padgs_count_instances(pointer(self.boxes), count, rows, pointer(per_row))
        total = int(per_row.sum())
        self.slot_start = torch.empty(count + 1, dtype=torch.int64)
        self.tile_start = torch.empty(self.count + 1, dtype=torch.int64)
        self.instances = torch.empty(total, dtype=torch.int32)
        self.slots = torch.empty(total, dtype=torch.int64)
        library.padgs_bin(
            pointer(self.boxes),
            count,
            pointer(order),
            self.visible,
            columns,
            0,
            rows,
            *map(pointer, (self.slot_start, self.tile_start, self.instances, self.slots)),
        )

    def blend_arguments(self, background, image, transmittance, depth, last, pair_counts) -> native.BlendArguments:
        """Arguments of both blending passes; the tensors must outlive the call."""
        tensors = (self.footprints, self.tile_start, self.instances, self.slots, background)
        outputs = (image, transmittance, depth, last, pair_counts)
        camera = self.camera
        return native.BlendArguments(
            camera.width, camera.height, camera.wrap, 0, self.rows, *map(pointer, tensors), *map(pointer, outputs)
        )
