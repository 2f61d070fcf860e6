"""Several samples a pixel: the image is rendered with smaller pixels, and each pixel is the mean of those it covers.

A camera's pixel is the mean over a square, and blending is not linear: a footprint at the centre of a pixel, however it
is filtered, is wrong where edges of opaque Gaussians cross the pixel.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, reduce

import torch
from torch import Tensor

from padgs.geometry.camera import Camera, Panorama, Pinhole, RayTable
from padgs.render.contract import Rendering, Request


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
    """Return a camera with `times` the columns and rows, which sees the same; between rays of a table, linearly."""
    width, height = times * camera.width, times * camera.height
    if isinstance(camera, Panorama):
        return Panorama(width, height)
    if isinstance(camera, Pinhole):
        lens = {name: times * getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
        return replace(camera, width=width, height=height, **lens)
    return _finer_table(camera, times) if camera.table.requires_grad else _kept_table(camera, times)


def _finer_table(camera: RayTable, times: int) -> RayTable:
    rays = camera.table
    offsets = (torch.arange(times, dtype=rays.dtype, device=rays.device) + 0.5) / times - 0.5  # from pixel centres
    for dim in (0, 1):
        slope = torch.gradient(rays, dim=dim)[0] if rays.shape[dim] > 1 else torch.zeros_like(rays)
        slope = slope.nan_to_num()  # beside a ray that is none
        rays = rays.unsqueeze(dim + 1) + offsets[:, None].view(-1, *(1,) * (2 - dim)) * slope.unsqueeze(dim + 1)
        rays = rays.flatten(dim, dim + 1)
    return RayTable(torch.nn.functional.normalize(rays, dim=-1), times * camera.focal, camera.kind)


_kept_table = lru_cache(maxsize=16)(_finer_table)  # views of a camera share it
