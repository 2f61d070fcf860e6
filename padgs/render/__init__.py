"""Rendering: one function, several backends. Models and methods call `render(gaussians, view)`.

Backends are the entries of `BACKENDS`; each is a `padgs.render.contract.Backend`. Backend torch is the definition.
"""

import warnings
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from typing import Any

import torch
from torch import Tensor

from padgs.checks import check_known, lookup
from padgs.gaussians import Gaussians
from padgs.geometry.camera import Pinhole
from padgs.native import LIBRARIES, library_for
from padgs.render.contract import LOW_PASS_KINDS, Backend, Rendering, RenderOptions, Request, check_inputs
from padgs.render.cubemap import rasterize_cubemap, summed_counters
from padgs.render.ray_blocks import is_in_blocks, rasterize_blocks, seen
from padgs.render.supersampling import rasterize_samples
from padgs.scene import View

BACKENDS = {
    "torch": "padgs.render.backends.torch:rasterize",
    "cpu": "padgs.render.backends.cpu:rasterize",
    "cuda": "padgs.render.backends.cuda:rasterize",
}

__all__ = ["BACKENDS", "RenderConfig", "RenderOptions", "Rendering", "make_request", "render", "resolve_backend"]


@dataclass(frozen=True)
class RenderConfig(RenderOptions):
    """The `render` group of the configuration: `RenderOptions` with lengths relative to the scene."""

    near: float = 0.01  # smallest distance that is drawn, in `near_unit`
    near_unit: str = "scene"  # scene: multiples of Scene.scale; world: world units, as the published code
    backend: str = "auto"  # auto | torch | cpu | cuda

    def __post_init__(self) -> None:
        check_known(self, projection=LOW_PASS_KINDS, near_unit=("scene", "world"), backend=("auto", *BACKENDS))
        super().__post_init__()

    def options(self, scene_scale: float) -> RenderOptions:
        """Return the renderer options for a scene whose scale is `scene_scale` world units."""
        values: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(RenderOptions)}
        if self.near_unit == "scene":
            values["near"] *= scene_scale
        return RenderOptions(**values)


def render(
    gaussians: Gaussians,
    view: View,
    options: RenderOptions = RenderOptions(),  # noqa: B008 - frozen dataclass
    *,
    background: Tensor | None = None,
    mean_offsets: Tensor | None = None,
    absgrad: Tensor | None = None,
    backend: str = "auto",
) -> Rendering:
    """Render the Gaussians from the camera of the view; a ValueError for inputs that break the contract.

    Args:
        gaussians: N Gaussians in the world frame, float32 (any backend) or float64 (torch only).
        view: pose and camera.
        options: projection, bounds, culling; whether a panorama is rendered directly or as a cubemap.
        background: [3] RGB; black if not given.
        mean_offsets: [N, 2] added to the projected means, in units of which x and y span 2 across the image, as in
            3DGS; with projections tangent and ray across a full panorama, whatever the camera. For zeros, the gradient
            after `backward` is the positional gradient of densification.
        absgrad: [N] zeros that change nothing; projection ray only. The gradient after `backward` is the sum over the
            pixels of |dL/dmean| through each pixel alone, which do not cancel (`WithAbsgrad` of backend torch).
        backend: a name of `BACKENDS`, or auto: cpu or cuda, by the device, for float32 tensors if the library is built;
            torch otherwise (with one warning if the library is missing).
    """
    request = make_request(gaussians, view, options, background, mean_offsets, absgrad)
    name = resolve_backend(backend, gaussians.means)
    if options.supersampling > 1:
        return rasterize_samples(partial(_rasterize, name), request)
    return _rasterize(name, request)


def _rasterize(name: str, request: Request) -> Rendering:
    """Render by the backend of that name, with one sample a pixel."""
    rasterize: Backend = lookup(BACKENDS, name, "backend")
    if request.options.cubemap:
        return rasterize_cubemap(rasterize, request)
    in_blocks = is_in_blocks(request.camera)
    if name != "torch":
        return rasterize_blocks(rasterize, request) if in_blocks else rasterize(request)
    rendering = rasterize(request)
    by_rays = isinstance(request.camera, Pinhole) and request.options.projection in ("tangent", "ray")
    if not in_blocks and not by_rays:
        return rendering
    visible = rendering.visible & seen(request)  # it tries all Gaussians in all pixels
    return replace(rendering, visible=visible, counters=summed_counters([rendering], visible))


def make_request(
    gaussians: Gaussians,
    view: View,
    options: RenderOptions,
    background: Tensor | None = None,
    mean_offsets: Tensor | None = None,
    absgrad: Tensor | None = None,
) -> Request:
    """Return the input of a backend for the arguments of `render`; ValueError if they break the contract."""
    means = gaussians.means
    cam_from_world = view.cam_from_world.to(device=means.device, dtype=means.dtype)
    if background is None:
        background = means.new_zeros(3)
    request = Request(gaussians, cam_from_world, view.camera, options, background, mean_offsets, absgrad)
    check_inputs(request)
    return request


def resolve_backend(backend: str, means: Tensor) -> str:
    """Return the backend that `auto` selects for these tensors; other names are returned unchanged."""
    if backend != "auto":
        return backend
    if library_for(means) is not None:
        return means.device.type
    if means.device.type in LIBRARIES and means.dtype == torch.float32:
        _warn_missing_library(means.device)
    return "torch"


@cache  # once in a process for each device, whatever the filters of the warnings module say
def _warn_missing_library(device: torch.device) -> None:
    try:
        LIBRARIES[device.type].require(device)
    except (OSError, RuntimeError) as error:
        warnings.warn(f"rendering with backend torch, many times slower than {device.type}: {error}", stacklevel=4)
