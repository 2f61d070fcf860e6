"""How far what a pixel shows is, by who else sees its colours there: a plane sweep on the sphere (Collins 1996).

A range that is interpolated between points of a sparse cloud may be far off. Of several ranges between those of the
points around, that one is taken at which the pixels look the same in the views nearby.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from padgs.geometry.camera import Panorama
from padgs.geometry.panorama import sample
from padgs.scene import View
from padgs.training.targets import image_of

OTHERS = 4  # views that are asked; the better half of them counts, for in the others something may stand before it
TRIED = 13  # inverse ranges, from below those of the points around to above
BEYOND = 1.2  # times the least and the largest of them
PATCH = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))  # pixels across and along
DOUBT = 0.01  # of the range of colours: how much better an octave away must look
PARALLAX = 1e-3  # of a range; a camera that moved by less sees nothing move
AT_ONCE = 4096  # pixels, so that memory does not follow their number


def swept(view: View, rays: Tensor, inverse_range: Tensor, around: Tensor, views: Sequence[View]) -> Tensor:
    """Inverse ranges [n] of pixels of a view at which the views nearby see them alike.

    Args:
        view: with a photograph; if it is no panorama, nothing is changed.
        rays: [n, 3] float64, of the pixels, in its camera frame.
        inverse_range: [n] > 0, what is likely, 1 / world units.
        around: [n, K] > 0, those of points around.
        views: all there are; those that are no panoramas, or stand where this one does (within `PARALLAX` of the median
            range), are not asked. What their masks hide is asked all the same; it is outvoted, as what hides behind
            something is.
    """
    if not isinstance(view.camera, Panorama) or len(rays) == 0:
        return inverse_range
    least = PARALLAX / inverse_range.median().item()
    others = [other for other in views if isinstance(other.camera, Panorama)]
    apart = [_apart(view, other) for other in others]
    nearest = sorted((number for number, away in enumerate(apart) if away > least), key=lambda number: apart[number])
    others = [others[number] for number in nearest[:OTHERS]]
    if not others:
        return inverse_range
    parts = zip(*(tensor.split(AT_ONCE) for tensor in (rays, inverse_range, around)), strict=True)
    images = [image_of(other, torch.device("cpu")) for other in (view, *others)]
    return torch.cat([_swept(view, others, images, *part) for part in parts])


def _swept(
    view: View, others: Sequence[View], images: Sequence[Tensor], rays: Tensor, inverse_range: Tensor, around: Tensor
) -> Tensor:
    low, high = around.amin(1, keepdim=True) / BEYOND, around.amax(1, keepdim=True) * BEYOND
    between = low * (high / low) ** torch.linspace(0, 1, TRIED, dtype=low.dtype)
    tried = torch.cat((inverse_range[:, None], between), dim=1)  # [n, R]
    patch = _patch(rays, 2 * math.pi / view.width)  # [n, P, 3]
    own = sample(images[0], patch.float())
    places = (patch[:, None] / tried[:, :, None, None]).float()  # [n, R, P, 3] in the frame of the view
    unlike = [_unlike(own, places, image, _from(view, other)) for image, other in zip(images[1:], others, strict=True)]
    better = torch.stack(unlike).sort(0).values[: math.ceil(len(others) / 2)]
    cost = better.mean(0) + DOUBT * (tried / inverse_range[:, None]).log2().abs()
    return tried.gather(1, cost.argmin(1, keepdim=True))[:, 0]


def _apart(one: View, other: View) -> float:
    """Distance between two cameras, world units."""
    return float((one.center - other.center).norm())


def _from(view: View, other: View) -> Tensor:
    """[4, 4] float32, from the frame of a view to that of another."""
    return (other.cam_from_world.double() @ view.cam_from_world.double().inverse()).float().cpu()


def _patch(rays: Tensor, pixel: float) -> Tensor:
    """Directions [n, P, 3] about rays [n, 3], a pixel being so many radians."""
    helper = torch.eye(3, dtype=rays.dtype)[rays.abs().argmin(-1)]  # the axis that is furthest from a ray
    across = functional.normalize(torch.linalg.cross(rays, helper), dim=-1)
    along = torch.linalg.cross(rays, across)
    directions = [rays + pixel * (a * across + b * along) for a, b in PATCH]
    return functional.normalize(torch.stack(directions, dim=1), dim=-1)


def _unlike(own: Tensor, places: Tensor, image: Tensor, other_from_view: Tensor) -> Tensor:
    """Mean difference [n, R] of colours [n, P, 3] from what another view shows at places [n, R, P, 3]."""
    seen = sample(image, places @ other_from_view[:3, :3].T + other_from_view[:3, 3])
    return (seen - own[:, None]).abs().mean((-1, -2)).double()
