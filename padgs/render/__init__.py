"""Rendering: one function, several backends. `render(gaussians, view)` is all that models and methods call.

Backends are entries of `BACKENDS`; each is a `padgs.render.contract.Backend`. The torch one is the definition.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.registry import lookup
from padgs.render.contract import Backend, Rendering, RenderOptions, Request, check_inputs
from padgs.render.cubemap import rasterize_cubemap
from padgs.scene import View

BACKENDS = {
    "torch": "padgs.render.backends.torch:rasterize",
    "cpu": "padgs.render.backends.cpu:rasterize",
    "cuda": "padgs.render.backends.cuda:rasterize",
}

__all__ = ["BACKENDS", "RenderOptions", "Rendering", "render", "request_of", "resolve_backend"]


def render(
    gaussians: Gaussians,
    view: View,
    options: RenderOptions = RenderOptions(),  # noqa: B008 - frozen dataclass
    *,
    background: Tensor | None = None,
    probe: Tensor | None = None,
    absolute_probe: Tensor | None = None,
    backend: str = "auto",
    check_values: bool = False,
) -> Rendering:
    """Render the Gaussians as the view sees them.

    Args:
        gaussians: N Gaussians in the world frame, float32 (any backend) or float64 (torch only).
        view: pose and image size.
        options: projection, bounds, culling; whether a panorama is drawn at once or as a cubemap.
        background: [3] RGB behind everything; black if not given.
        probe: [N, 2] zeros that move the projected means, in normalised image units (x and y each run over 2 across
            the image, as in 3DGS); its gradient after `backward` is the densification signal.
        absolute_probe: [N] zeros that change nothing; projection ray. After `backward` its gradient is the sum over the
            pixels of |dL/dmean| by way of each alone, which do not cancel (`padgs.render.absolute`).
        backend: a name of `BACKENDS`, or auto: cpu or cuda for float32 tensors that are there, if the library for it is
            built, else torch (and a warning, once, if that is because the library is missing).
        check_values: also check that all numbers are sane; a pass over the tensors, meant for tests and debugging.

    Raises:
        ValueError: unknown backend, or inputs that break the contract.
    """
    request = request_of(gaussians, view, options, background, probe, absolute_probe, check_values=check_values)
    rasterize: Backend = lookup(BACKENDS, resolve_backend(backend, gaussians.means), "backend")
    return rasterize_cubemap(rasterize, request) if options.cubemap else rasterize(request)


def request_of(
    gaussians: Gaussians,
    view: View,
    options: RenderOptions,
    background: Tensor | None = None,
    probe: Tensor | None = None,
    absolute_probe: Tensor | None = None,
    *,
    check_values: bool = False,
) -> Request:
    """What a backend is asked for, from the arguments of `render`.

    Raises:
        ValueError: they break the contract.
    """
    means = gaussians.means
    cam_from_world = view.cam_from_world.to(device=means.device, dtype=means.dtype)
    if background is None:
        background = means.new_zeros(3)
    request = Request(gaussians, cam_from_world, view.camera, options, background, probe, absolute_probe)
    check_inputs(request, check_values=check_values)
    if options.pixel_bias:
        bias = 2 * options.pixel_bias / means.new_tensor([view.camera.width, view.camera.height])
        request = replace(request, probe=bias.expand(len(means), 2) if probe is None else probe + bias)
    return request


def resolve_backend(backend: str, means: Tensor) -> str:
    """The backend that `auto` stands for, given the tensors to draw; other names are returned as they are."""
    if backend != "auto":
        return backend
    from padgs.native import LIBRARIES

    library = LIBRARIES.get(means.device.type)
    if library is None or means.dtype != torch.float32:
        return "torch"
    if library.works_on(means.device):
        return means.device.type
    _say_that_native_is_missing(means.device)
    return "torch"


@cache  # once in a process for each device, whatever the filters of the warnings module say
def _say_that_native_is_missing(device: torch.device) -> None:
    from padgs.native import LIBRARIES

    try:
        LIBRARIES[device.type].require(device)
    except (OSError, RuntimeError) as error:
        warnings.warn(f"rendering with backend torch, many times slower than {device.type}: {error}", stacklevel=4)
