"""Targets of the loss: image, weight and SSIM statistics of each training view, at full or reduced size."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from padgs.geometry.camera import Panorama
from padgs.scene import View
from padgs.training.loss import SSIMStatistics, fits, photometric_loss, pixel_weight, ssim_statistics

CACHE_BYTES = 1 << 29  # weights and statistics of views beyond this are computed again at every iteration
MIN_WIDTH = 512  # pixels; smaller panoramas gain nothing from a smaller start


@dataclass(frozen=True)
class Target:
    """Image, weight and SSIM statistics of one view."""

    image: Tensor  # [H, W, 3]
    weight: Tensor  # [H, W] or [H, 1]
    statistics: SSIMStatistics | None  # None if the loss computes its own

    def loss(self, image: Tensor, lambda_l1: float, normalisation: str) -> Tensor:
        """Return the photometric loss of an image [H, W, 3], a scalar."""
        return photometric_loss(
            image, self.image, self.weight, lambda_l1, normalisation=normalisation, statistics=self.statistics
        )


class Targets(Sequence[Target]):
    """The targets of views, by index; weights and statistics are cached within `CACHE_BYTES`."""

    def __init__(self, views: Sequence[View], weight: str, device: torch.device | str = "cpu") -> None:
        """Load nothing yet; `weight` is a name of `padgs.training.loss.ROW_WEIGHTS`."""
        self._views, self._weight, self._device = views, weight, device
        self._weights: dict[int, Tensor] = {}
        self._statistics: dict[int, SSIMStatistics] = {}
        self._bytes_left = CACHE_BYTES

    def __len__(self) -> int:
        """Number of views."""
        return len(self._views)

    def __getitem__(self, index: int) -> Target:
        """Return the target of view `index`.

        Raises:
            ValueError: image or mask have another size than the view, or there is no image, or the mask is 0.
        """
        image = image_of(self._views[index], self._device)
        weight = self._weights.get(index)
        if weight is None:
            weight = weight_of(self._views[index], self._weight, self._device)
            if self._is_cached(weight.nbytes):
                self._weights[index] = weight
        return Target(image, weight, None if fits(image) else self._statistics_of(index, image))

    def _statistics_of(self, index: int, image: Tensor) -> SSIMStatistics:
        if index in self._statistics:
            return self._statistics[index]
        statistics = ssim_statistics(image)
        if self._is_cached(2 * image.nbytes):
            self._statistics[index] = statistics
        return statistics

    def _is_cached(self, size: int) -> bool:
        """Return whether `size` more bytes may be cached, and reserve them."""
        cached = size <= self._bytes_left
        self._bytes_left -= size if cached else 0
        return cached


def image_of(view: View, device: torch.device | str = "cpu") -> Tensor:
    """Return the image [H, W, 3] of a view, in [0, 1].

    Raises:
        ValueError: the view has no image, or one of another size.
    """
    return _checked_size(view, "image", view.image(device=device))


def weight_of(view: View, weight: str, device: torch.device | str = "cpu") -> Tensor:
    """Return the weight of the pixels of a view, [H, W], or [H, 1] without a mask; `weight` is in `ROW_WEIGHTS`.

    Raises:
        ValueError: the mask has another size than the view, or is 0 everywhere.
    """
    mask = view.mask(device=device)
    mask = None if mask is None else _checked_size(view, "mask", mask)
    try:
        return pixel_weight(weight, view.height, mask, device=device)
    except ValueError as error:
        raise ValueError(f"view {view.name!r}: {error}") from error


def even_weight(view: View, device: torch.device) -> Tensor:
    """Return the weight [H, W] or [H, 1] by solid angle for panoramas, and uniform for other views."""
    return weight_of(view, "solid_angle" if isinstance(view.camera, Panorama) else "uniform", device)


def _checked_size(view: View, what: str, pixels: Tensor) -> Tensor:
    height, width = pixels.shape[:2]
    if (height, width) != (view.height, view.width):
        raise ValueError(f"{what} of view {view.name!r} is {width}x{height}; the view is {view.width}x{view.height}")
    return pixels


class CoarseToFine:
    """Views and their targets, smaller at the beginning of a run.

    From `coarse_share` of the run on, views have their own size; before that half of it, a quarter in the first half of
    that time, and so on, as long as all views are panoramas of `MIN_WIDTH` or more.
    """

    def __init__(self, views: Sequence[View], weight: str, device: torch.device, coarse_share: float) -> None:
        """Load nothing yet; `weight` is a name of `padgs.training.loss.ROW_WEIGHTS`."""
        self._coarse_share, self._levels = coarse_share, [(views, Targets(views, weight, device))]
        while views and all(view.lens is None and view.width >= 2 * MIN_WIDTH for view in views):
            views = [halved(view) for view in views]
            self._levels.append((views, Targets(views, weight, device)))

    def halvings(self, progress: float) -> int:
        """Return how often views are halved in a step that ends at a share of the run in (0, 1]."""
        if progress >= self._coarse_share:
            return 0
        return min(math.ceil(math.log2(self._coarse_share / progress)), len(self._levels) - 1)

    def at(self, progress: float) -> tuple[Sequence[View], Targets]:
        """Return views and targets of such a step."""
        return self._levels[self.halvings(progress)]


def halved(view: View) -> View:
    """Return a panorama at half the width and height, each pixel the mean of those that it covers."""
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
