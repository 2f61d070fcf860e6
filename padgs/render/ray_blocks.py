"""Images of arbitrary rays, such as photographs through a lens with distortion, in blocks of pixels.

Native backends bound a Gaussian in panoramas and pinholes by formulas. In other images it would be tried in every
pixel. So the image is drawn block by block, each with the Gaussians that reach the cone around its rays.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache

import torch
from torch import Tensor

from padgs.geometry.camera import Camera, RayTable
from padgs.render.backends.native import off_panorama
from padgs.render.contract import Backend, Removals, Rendering, Request, largest_q
from padgs.render.cubemap import summed_counters
from padgs.render.projection import camera_frame
from padgs.render.projective import mean_shift

BLOCK = 64  # pixels
SLACK = 1e-3  # radians, above the rounding of angles in float32


def is_in_blocks(camera: Camera) -> bool:
    """Return whether a camera's image is drawn in blocks: a table of rays that are not learned, and no panorama's."""
    return isinstance(camera, RayTable) and not camera.table.requires_grad and off_panorama(camera.table) < 0


def rasterize_blocks(rasterize: Backend, request: Request) -> Rendering:
    """Render a table of rays by a backend, block by block; the result is that of the whole table."""
    parts, visible = [], torch.zeros_like(request.gaussians.opacities, dtype=torch.bool)
    for block, _, rows in _in_sight(request):
        given = (request.mean_offsets, request.absgrad)
        offsets, absgrad = (None if tensor is None else tensor[rows] for tensor in given)
        own = replace(request, gaussians=request.gaussians.chosen(rows), camera=block)
        parts.append(rasterize(replace(own, mean_offsets=offsets, absgrad=absgrad)))
        visible[rows[parts[-1].visible]] = True
    across = -(-request.camera.width // BLOCK)
    image, transmittance, depth = (
        torch.cat([torch.cat(pixels[start : start + across], 1) for start in range(0, len(parts), across)])
        for pixels in ([getattr(part, name) for part in parts] for name in ("image", "transmittance", "depth"))
    )
    return Rendering(image, transmittance, depth, visible, summed_counters(parts, visible))


def score_blocks(score: Callable[..., Removals], request: Request, target: Tensor, weight: Tensor) -> Removals:
    """Score a table of rays by a backend of `leave_one_out`, block by block."""
    count, found = len(request.gaussians), None
    for block, pixels, rows in _in_sight(request):
        own = replace(request, gaussians=request.gaussians.chosen(rows), camera=block)
        part = vars(score(own, target[pixels].contiguous(), weight[pixels].contiguous()))
        found = found or {name: values.new_zeros(count) for name, values in part.items()}
        for name, values in part.items():  # the peak is the largest of the blocks, all else are sums over pixels
            old = found[name][rows]
            found[name][rows] = torch.maximum(old, values) if name == "peak" else old + values
    assert found is not None, "guaranteed by `check_inputs`: an image has pixels"
    return Removals(**found)


@torch.no_grad()
def seen(request: Request) -> Tensor:
    """Return which Gaussians [N] reach a block of the image."""
    found = torch.zeros(len(request.gaussians), dtype=torch.bool, device=request.gaussians.means.device)
    for _, _, rows in _in_sight(request):
        found[rows] = True
    return found


@torch.no_grad()
def _in_sight(request: Request) -> Iterator[tuple[RayTable, tuple[slice, slice], Tensor]]:
    """Yield blocks of the image, row by row, with their pixels and the indices of the Gaussians that reach them.

    A Gaussian is drawn within k standard deviations, k^2 = `largest_q`, along its longest axis with the
    low-pass filter; seen from the camera that is an angle of at most asin(k sigma / r).
    """
    gaussians, options, camera = request.gaussians, request.options, request.camera
    means = camera_frame(request)[0]
    if request.mean_offsets is not None:
        means = means + mean_shift(means, request.mean_offsets)
    radius = means.norm(dim=-1).clamp(min=1e-30)
    spread = (gaussians.scales.amax(-1) / radius).square() + options.low_pass / camera.focal**2
    largest = largest_q(gaussians.opacities, options.steepness)
    reach = torch.asin((largest * spread).sqrt().clamp(max=1)) + SLACK
    everywhere = largest * spread >= 1
    directions = means / radius[:, None]
    for block, pixels, axis, angle in _blocks(camera):
        away = torch.acos((directions @ axis.to(directions)).clamp(-1, 1))
        yield block, pixels, (everywhere | (away <= reach + angle)).nonzero()[:, 0]


@lru_cache(maxsize=16)  # a table takes four times the memory of an image, and views of a camera share one
def _blocks(camera: Camera) -> tuple[tuple[RayTable, tuple[slice, slice], Tensor, float], ...]:
    """Return blocks of `BLOCK` x `BLOCK` pixels or fewer, row by row, with axis [3] and half angle of their cones."""
    found, whole = [], camera if isinstance(camera, RayTable) else RayTable(camera.rays(), camera.focal)
    for top in range(0, camera.height, BLOCK):
        for left in range(0, camera.width, BLOCK):
            pixels = slice(top, top + BLOCK), slice(left, left + BLOCK)
            rays = whole.table[pixels].double().flatten(0, 1)
            rays = torch.nn.functional.normalize(rays[rays.isfinite().all(1)], dim=1)  # others spoil their pixel only
            axis = torch.nn.functional.normalize(rays.mean(0), dim=0) if len(rays) else rays.new_tensor((0, 0, 1))
            angle = torch.acos((rays @ axis).amin().clamp(-1, 1)).item() if len(rays) else math.pi
            found.append((replace(whole, table=whole.table[pixels].contiguous()), pixels, axis, angle))
    return tuple(found)
