"""Down-weighting of what moves: pixels that are wrong in one training view and right in the others.

The surface that a pixel of a render shows is looked up in photographs of nearby views. Where these agree with the
render and the own photograph does not, the photograph shows a passer-by, or what travels with the camera. Where
nothing agrees, such as detail that has not been learned yet, the pixel keeps its weight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from padgs.geometry.camera import Panorama
from padgs.geometry.panorama import pad_panorama, sample
from padgs.render import Rendering
from padgs.scene import View
from padgs.training.targets import Target, Targets

OTHERS = 4  # nearby views; the better half counts, for the others may be occluded
LEAST_ERROR = 0.02  # of the range of colours, added to the error of the others
WINDOW = 1 / 128  # of the width: radius of the neighbourhood over which errors are averaged
FROM = 0.05  # share of the run before which renders say too little


class Outliers:
    """Weights of the pixels of training panoramas by comparison with each other."""

    def __init__(self, views: Sequence[View], targets: Targets, ratio: float) -> None:
        """Find the nearest views of each; pixels with an error above `ratio` times that of the others weigh less.

        Raises:
            ValueError: there are fewer than three views, or one is no panorama.
        """
        other = next((view for view in views if not isinstance(view.camera, Panorama)), None)
        if other is not None or len(views) < 3:
            what = f"{len(views)} training views" if other is None else f"view {other.name!r} of another camera"
            raise ValueError(
                f"train.outlier_ratio is {ratio}, but there are {what}; it compares three panoramas or more: set null"
            )
        centers = torch.stack([view.center.double().cpu() for view in views])
        distances = torch.cdist(centers, centers).fill_diagonal_(math.inf)
        self._nearest = distances.argsort(dim=1, stable=True)[:, : min(OTHERS, len(views) - 1)].tolist()
        self._targets, self._ratio = targets, ratio

    @torch.no_grad()
    def weighted(self, index: int, view: View, rendering: Rendering, target: Target, progress: float) -> Target:
        """Return the target of view `index` with lower weights where its photograph alone is wrong."""
        if progress < FROM:
            return target
        image, pose = rendering.image, view.cam_from_world.to(rendering.depth)
        points = view.camera.rays(dtype=image.dtype, device=image.device) * rendering.depth[..., None]
        world = (points - pose[:3, 3]) @ pose[:3, :3]
        own, errors = _smooth((image - target.image).abs().mean(-1)), []
        for number in self._nearest[index]:
            other, seen = self._targets.at(number, progress)
            there = other.cam_from_world.to(image)
            rays = world @ there[:3, :3].T + there[:3, 3]
            visible = seen.weight.expand(other.height, other.width)[..., None] > 0
            colors, share = sample(torch.cat((seen.image, visible), dim=-1), rays).split((3, 1), dim=-1)
            error = _smooth((image - colors).abs().mean(-1))
            errors.append(torch.where(share[..., 0] > 0.99, error, math.inf))
        better = torch.stack(errors).sort(0).values[: (len(errors) + 1) // 2].mean(0)
        ratio = own / (self._ratio * (better + LEAST_ERROR))
        return replace(target, weight=target.weight * ratio.clamp(min=1).square().reciprocal())


def _smooth(error: Tensor) -> Tensor:
    """Return the mean of errors [H, W] over the neighbourhood of each pixel, across the seam and the poles."""
    radius = max(1, round(WINDOW * error.shape[1]))
    padded = pad_panorama(error[..., None], radius)[..., 0]
    return avg_pool2d(padded[None], 2 * radius + 1, stride=1)[0]
