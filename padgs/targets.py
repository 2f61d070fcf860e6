"""What the loss compares renderings with: image, weight and SSIM moments of each training view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.fused_loss import fits
from padgs.loss import TargetMoments, pixel_weight, target_moments
from padgs.scene import View

CACHE_BYTES = 1 << 29  # moments of views beyond this are computed again at every iteration


@dataclass(frozen=True)
class Target:
    """One view, ready for `padgs.loss.photometric_loss`."""

    image: Tensor  # [H, W, 3]
    weight: Tensor  # [H, W] or [H, 1]
    moments: TargetMoments | None  # None where the loss does without


class Targets(Sequence[Target]):
    """The targets of some views, by number. Keeps what fits into a fixed amount of memory."""

    def __init__(self, views: Sequence[View], weight: str, device: torch.device | str = "cpu") -> None:
        """Load nothing yet; `weight` is a name of `padgs.loss.ROW_WEIGHTS`."""
        self._views, self._weight, self._device = views, weight, device
        self._moments: dict[int, TargetMoments] = {}
        self._bytes_left = CACHE_BYTES

    def __len__(self) -> int:
        """Number of views."""
        return len(self._views)

    def __getitem__(self, index: int) -> Target:
        """The target of view `index`.

        Raises:
            ValueError: the view has no pixels, or they have another size than the view, or the mask leaves none.
        """
        image, weight = image_and_weight(self._views[index], self._weight, self._device)
        return Target(image, weight, None if fits(image) else self._moments_of(index, image))

    def _moments_of(self, index: int, image: Tensor) -> TargetMoments:
        if index in self._moments:
            return self._moments[index]
        moments = target_moments(image)
        size = 2 * image.numel() * image.element_size()
        if size <= self._bytes_left:
            self._bytes_left -= size
            self._moments[index] = moments
        return moments


def image_and_weight(view: View, weight: str, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor]:
    """Image [H, W, 3] in [0, 1] of a view and the weight of its pixels, [H, W] or [H, 1].

    Raises:
        ValueError: the view has no pixels, or they have another size than the view, or the mask leaves none.
    """
    image, mask = view.image(device=device), view.mask(device=device)
    for what, tensor in (("image", image), ("mask", mask)):
        if tensor is not None and tuple(tensor.shape[:2]) != (view.height, view.width):
            size = f"{tensor.shape[1]}x{tensor.shape[0]}"
            raise ValueError(f"{what} of view {view.name!r} is {size}; the view is {view.width}x{view.height}")
    try:
        return image, pixel_weight(weight, view.height, mask, device=device)
    except ValueError as error:
        raise ValueError(f"view {view.name!r}: {error}") from error
