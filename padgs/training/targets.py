"""What the loss compares renderings with: image, weight and SSIM statistics of each training view."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from padgs.geometry.camera import Panorama
from padgs.scene import View
from padgs.training.loss import SSIMStatistics, fits, pixel_weight, ssim_statistics

CACHE_BYTES = 1 << 29  # weights and statistics of views beyond this are computed again at every iteration


@dataclass(frozen=True)
class Target:
    """One view, ready for `padgs.training.loss.photometric_loss`."""

    image: Tensor  # [H, W, 3]
    weight: Tensor  # [H, W] or [H, 1]
    statistics: SSIMStatistics | None  # None where the loss does without


class Targets(Sequence[Target]):
    """The targets of some views, by number. Keeps what fits into a fixed amount of memory."""

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
        """The target of view `index`.

        Raises:
            ValueError: the view has no pixels, or they have another size than the view, or the mask leaves none.
        """
        image = image_of(self._views[index], self._device)
        weight = self._weights[index] if index in self._weights else self._weight_of(index)
        return Target(image, weight, None if fits(image) else self._statistics_of(index, image))

    def _weight_of(self, index: int) -> Tensor:
        weight = weight_of(self._views[index], self._weight, self._device)
        if self._keeps(weight.nbytes):
            self._weights[index] = weight
        return weight

    def _statistics_of(self, index: int, image: Tensor) -> SSIMStatistics:
        if index in self._statistics:
            return self._statistics[index]
        statistics = ssim_statistics(image)
        if self._keeps(2 * image.nbytes):
            self._statistics[index] = statistics
        return statistics

    def _keeps(self, size: int) -> bool:
        """Whether so many bytes more may be kept; they count from now on."""
        kept = size <= self._bytes_left
        self._bytes_left -= size if kept else 0
        return kept


def image_of(view: View, device: torch.device | str = "cpu") -> Tensor:
    """Image [H, W, 3] in [0, 1] of a view.

    Raises:
        ValueError: the view has no pixels, or they have another size than the view.
    """
    return _fitting(view, "image", view.image(device=device))


def weight_of(view: View, weight: str, device: torch.device | str = "cpu") -> Tensor:
    """Weight of the pixels of a view, [H, W], or [H, 1] without a mask; `weight` is a name of `ROW_WEIGHTS`.

    Raises:
        ValueError: the mask has another size than the view, or leaves no pixel.
    """
    mask = view.mask(device=device)
    mask = None if mask is None else _fitting(view, "mask", mask)
    try:
        return pixel_weight(weight, view.height, mask, device=device)
    except ValueError as error:
        raise ValueError(f"view {view.name!r}: {error}") from error


def even_weight(view: View, device: torch.device) -> Tensor:
    """Weight [H, W] or [H, 1] of pixels: all directions of a panorama count alike, and all pixels of other views."""
    return weight_of(view, "solid_angle" if isinstance(view.camera, Panorama) else "uniform", device)


def _fitting(view: View, what: str, pixels: Tensor) -> Tensor:
    height, width = pixels.shape[:2]
    if (height, width) != (view.height, view.width):
        raise ValueError(f"{what} of view {view.name!r} is {width}x{height}; the view is {view.width}x{view.height}")
    return pixels


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
