"""The training views in several sizes: small ones first, of which an iteration takes a fraction of the time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from padgs.scene import View
from padgs.training.targets import Targets

LEAST_WIDTH = 512  # pixels; smaller panoramas gain nothing by beginning smaller still


class Sizes:
    """Views and their targets, by how much of a run is done.

    They have their own size from `coarse_share` of the run on; half of it before, a quarter of it in the first half of
    that time, and so on, as long as all are panoramas of `LEAST_WIDTH` or more.
    """

    def __init__(self, views: Sequence[View], weight: str, device: torch.device, coarse_share: float) -> None:
        """Load nothing yet; `weight` is a name of `padgs.training.loss.ROW_WEIGHTS`."""
        self._coarse_share, self._levels = coarse_share, [(views, Targets(views, weight, device))]
        while views and all(view.lens is None and view.width >= 2 * LEAST_WIDTH for view in views):
            views = [halved(view) for view in views]
            self._levels.append((views, Targets(views, weight, device)))

    def halvings(self, progress: float) -> int:
        """How often views are halved in a step after which so much of the run is done, in (0, 1]."""
        if progress >= self._coarse_share:
            return 0
        return min(math.ceil(math.log2(self._coarse_share / progress)), len(self._levels) - 1)

    def at(self, progress: float) -> tuple[Sequence[View], Targets]:
        """What such a step draws."""
        return self._levels[self.halvings(progress)]


def halved(view: View) -> View:
    """The same panorama at half the width and height, each pixel the mean of those that it covers."""
    width, height = view.width // 2, view.height // 2

    def reduced(load: Callable[[], Tensor]) -> Tensor:
        image = load()
        planes = image.float().reshape(view.height, view.width, -1).permute(2, 0, 1)
        small = interpolate(planes[None], (height, width), mode="area")[0].permute(1, 2, 0)
        small = small.round().to(image.dtype) if image.dtype == torch.uint8 else small
        return small.reshape(height, width, *image.shape[2:]).contiguous()

    pixels, mask = view.load_pixels, view.load_mask
    return replace(
        view,
        width=width,
        height=height,
        load_pixels=None if pixels is None else lambda: reduced(pixels),
        load_mask=None if mask is None else lambda: reduced(mask),
        load_depth=None,
    )
