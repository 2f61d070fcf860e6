"""Several samples a pixel: the image is rendered with smaller pixels, and each pixel is the mean of those it covers.

A camera's pixel is the mean over a square, and blending is not linear: a footprint at the centre of a pixel, however it
is filtered, is wrong where edges of opaque Gaussians cross the pixel.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import reduce

import torch
from torch import Tensor

from padgs.geometry.camera import Camera, Panorama, Pinhole, RayTable
from padgs.render.contract import Rendering, Request


def is_supersampled(request: Request) -> bool:
    """Return whether pixels have several samples; the rays of a table are given, one a pixel."""
    return request.options.supersampling > 1 and not isinstance(request.camera, RayTable)


def rasterize_samples(rasterize: Callable[[Request], Rendering], request: Request) -> Rendering:
    """Render a camera with `supersampling` times the columns and rows, and average.

    `low_pass` is in square samples. Depth is the mean weighted by contribution, counters are those of the samples.
    """
    times = request.options.supersampling
    options = replace(request.options, supersampling=1)
    fine = rasterize(replace(request, camera=with_smaller_pixels(request.camera, times), options=options))

    def mean(samples: Tensor) -> Tensor:
        """Average [H n, W n, C] to [H, W, C]; adding slices takes a tenth of the time of `Tensor.mean`."""
        rows = reduce(torch.add, samples.unflatten(0, (-1, times)).unbind(1))
        return reduce(torch.add, rows.unflatten(1, (-1, times)).unbind(2)) / times**2

    coverage = (1 - fine.transmittance)[..., None]
    covered, distance = mean(coverage), mean(fine.depth[..., None] * coverage)
    depth = distance / covered.where(covered > 0, 1)
    return replace(fine, image=mean(fine.image), transmittance=(1 - covered)[..., 0], depth=depth[..., 0])


def with_smaller_pixels(camera: Camera, times: int) -> Camera:
    """Return a panorama or pinhole with `times` the columns and rows, which sees the same."""
    width, height = times * camera.width, times * camera.height
    if isinstance(camera, Panorama):
        return Panorama(width, height)
    assert isinstance(camera, Pinhole), f"{type(camera).__name__} has no smaller pixels"
    lens = {name: times * getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    return replace(camera, width=width, height=height, **lens)
