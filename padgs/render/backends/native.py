"""What the native rasterizers have in common: one `torch.autograd.Function`, with a drawing of either library inside.

What an image can be differentiated by, what is kept for the backward pass, and how the gradients of pose, background
and rays come about is said here. float32 only.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from padgs.geometry.camera import RayTable
from padgs.native.abi import ABSOLUTE_MOMENT, Inputs, pointer
from padgs.render.backends.native_camera import NativeRays
from padgs.render.contract import Removals, Rendering, Request

Pixels = tuple[Tensor, Tensor, Tensor]  # image [H, W, 3], transmittance [H, W], depth [H, W]


class Upstream(NamedTuple):
    """What going back starts with, and the one gradient that is filled on the way."""

    image: Tensor
    transmittance: Tensor | None
    depth: Tensor | None
    rays: Tensor | None  # zeros of the shape of the table; added to
    absolute: bool  # whether the absolute signal is asked for


class NativeImage(ABC):
    """One image of a native library, and what going back takes besides its pixels, which autograd keeps.

    (Pixels refer to the drawing, by way of autograd; if it referred to them, neither would be freed.)
    """

    counters: Mapping[str, int]
    rays: NativeRays

    def __init__(self, request: Request) -> None:
        self.camera, self.options = request.camera, request.options

    @abstractmethod
    def draw(self, inputs: Inputs, pose: Tensor, background: Tensor, *, differentiated: bool) -> tuple[Pixels, Tensor]:
        """The pixels, and which Gaussians [N] bool are visible; sets `counters` and `rays`."""

    @abstractmethod
    def moments(self, pixels: Pixels, background: Tensor, upstream: Upstream) -> Tensor:
        """Moments [N, MOMENTS] of all Gaussians, from the gradients of the pixels."""

    @abstractmethod
    def project_backward(
        self, inputs: Inputs, pose: Tensor, moments: Tensor, gradients: list[Tensor | None], *, needs_pose: bool
    ) -> Tensor | None:
        """Fill the gradients of means, quats, scales, opacities, colors and probe; returns that of the pose, [12]."""

    @abstractmethod
    def removals(self, pixels: Pixels, background: Tensor, target: Tensor, weight: Tensor) -> Removals:
        """What each Gaussian's removal does to the pixels of sorted blending; `weight` [H, W] sums to 1."""


class Leaves(NamedTuple):
    """What an image can be differentiated by, in the order in which autograd sees it; or one flag for each of them."""

    means: Any
    quats: Any
    scales: Any
    opacities: Any
    colors: Any
    probe: Any = None
    absolute_probe: Any = None
    cam_from_world: Any = None
    background: Any = None
    table: Any = None  # of the camera's rays


def rasterize_as(drawing: NativeImage, request: Request) -> Rendering:
    """Fill the drawing with what is requested, differentiably."""
    leaves = Leaves(
        **vars(request.gaussians),
        probe=request.probe,
        absolute_probe=request.absolute_probe,
        cam_from_world=request.cam_from_world,
        background=request.background,
        table=request.camera.table if isinstance(request.camera, RayTable) else None,
    )
    grad_enabled = torch.is_grad_enabled()  # never inside
    image, transmittance, depth, visible = _Rasterize.apply(drawing, grad_enabled, *leaves)
    return Rendering(image, transmittance, depth, visible, drawing.counters)


def score_as(drawing: NativeImage, request: Request, target: Tensor, weight: Tensor) -> Removals:
    """Draw what is requested, and score each Gaussian by it; no gradients."""
    attributes = [tensor.contiguous() for tensor in vars(request.gaussians).values()]
    probe = None if request.probe is None else request.probe.contiguous()
    pose, background = request.cam_from_world.contiguous(), request.background.contiguous()
    inputs = Inputs(len(request.gaussians), *map(pointer, (*attributes, probe)))
    pixels, _ = drawing.draw(inputs, pose, background, differentiated=False)
    return drawing.removals(pixels, background, target, weight)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, drawing: NativeImage, grad_enabled: bool, *leaves: Tensor | None):
        named = Leaves(*leaves)
        attributes = [None if t is None else t.detach().contiguous() for t in named[:6]]
        pose, background = (t.detach().contiguous() for t in (named.cam_from_world, named.background))
        inputs = Inputs(len(named.means), *map(pointer, attributes))
        differentiated = grad_enabled and any(ctx.needs_input_grad)
        pixels, visible = drawing.draw(inputs, pose, background, differentiated=differentiated)
        ctx.mark_non_differentiable(visible)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*attributes, pose, background, *pixels)
        ctx.drawing = drawing
        return *pixels, visible

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor | None, grad_transmittance, grad_depth, _):
        *attributes, pose, background, image, transmittance, depth = ctx.saved_tensors
        drawing, needs = ctx.drawing, Leaves(*ctx.needs_input_grad[2:])
        grad_image = torch.zeros_like(image) if grad_image is None else grad_image.contiguous()
        grad_transmittance, grad_depth = (g if g is None else g.contiguous() for g in (grad_transmittance, grad_depth))
        grad_rays = torch.zeros_like(drawing.rays.table) if needs.table else None
        upstream = Upstream(grad_image, grad_transmittance, grad_depth, grad_rays, needs.absolute_probe)
        moments = drawing.moments((image, transmittance, depth), background, upstream)
        inputs = Inputs(len(moments), *map(pointer, attributes))
        gradients = [None if t is None else torch.empty_like(t) for t in attributes]
        of_pose = drawing.project_backward(inputs, pose, moments, gradients, needs_pose=needs.cam_from_world)
        leaves = Leaves(*gradients)
        if needs.absolute_probe:
            leaves = leaves._replace(absolute_probe=moments[:, ABSOLUTE_MOMENT].clone())
        if of_pose is not None:
            leaves = leaves._replace(cam_from_world=torch.zeros_like(pose))
            leaves.cam_from_world[:3] = of_pose.view(3, 4).to(pose.dtype)
        if needs.background:
            leaves = leaves._replace(background=(grad_image * transmittance[..., None]).sum((0, 1)))
        if grad_rays is not None:
            leaves = leaves._replace(table=grad_rays[:, :, : image.shape[1]].permute(0, 2, 1))
        return None, None, *leaves
