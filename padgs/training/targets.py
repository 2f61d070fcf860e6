"""Training views in random order, and the targets of the loss: image and weight of each view."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from padgs.geometry.camera import Panorama, pixel_solid_angles
from padgs.geometry.panorama import Device
from padgs.scene import Scene, View
from padgs.training import loss as losses
from padgs.training.model import State
from padgs.training.options import TrainOptions

CACHE_BYTES = 1 << 29  # weights of views beyond this are computed again at every iteration
SLACK = 0.01  # of the sphere, by which photographs may show more than a panorama in one iteration
MIN_WIDTH = 512  # pixels; smaller panoramas gain nothing from a smaller start
BLACK = 8 / 255  # brightest value of a pixel that may show nothing


@dataclass(frozen=True)
class Target:
    """Image and weight of one view."""

    image: Tensor  # [H, W, 3]
    weight: Tensor  # [H, W] or [H, 1]
    depth: Tensor | None = None  # [H, W] as in `View.load_depth`, if it is used

    def loss(self, image: Tensor, depth: Tensor, options: TrainOptions, unit: float) -> Tensor:
        """Return the loss of an image [H, W, 3] and its depth [H, W], a scalar; `unit` is the scene scale."""
        loss = losses.photometric_loss(
            image, self.image, self.weight, options.lambda_l1, normalisation=options.normalisation
        )
        if self.depth is None:
            return loss
        more = losses.inverse_range_loss(depth, self.depth, self.weight, unit, options.depth_kind)
        return loss + options.depth_weight * more

    def with_background(self, image: Tensor, transmittance: Tensor, color: Sequence[float]) -> Tensor:
        """Return a render [H, W, 3] over a colour (three numbers), or over black where the photograph is black.

        Black pixels may be a void, such as the sky or the holes of a scan, which is to stay empty.
        """
        lit = self.image.amax(-1) > BLACK
        behind = transmittance * lit
        return image + torch.stack([behind * value for value in color], dim=-1)  # sending a tensor would wait for a GPU

    def squares(self, image: Tensor, options: TrainOptions, progress: float) -> Tensor | float:
        """Return what squared errors of an image [H, W, 3] add to the loss at a share of the run."""
        if options.square_weight == 0 or progress <= 1 - losses.SQUARES_SHARE:
            return 0.0
        return options.square_weight * losses.squared_error(image, self.image, self.weight)


class Targets:
    """The training views with their targets, smaller at the beginning of a run; weights are cached.

    From `coarse_share` of the run on, views have their own size; before that half of it, a quarter in the first half of
    that time, and so on, as long as all views are panoramas of `MIN_WIDTH` or more.
    """

    def __init__(
        self, views: Sequence[View], weight: str, device: Device = "cpu", coarse_share: float = 0.0, *, depth: str = ""
    ) -> None:
        """Load nothing yet; `weight` is a name of ROW_WEIGHTS, `depth` one of DEPTH_KINDS if depth maps are used."""
        if depth and not any(view.load_depth for view in views):
            raise ValueError("train.depth_weight is not 0, but no training view has a depth map; put them into depths/")
        if depth == losses.MEASURED and any(view.depth_is_relative for view in views):
            raise ValueError("train.depth_kind=measured, but depth maps are relative; set train.depth_kind=monocular")
        self._weight, self._device, self._coarse_share, self._depth = weight, device, coarse_share, depth
        self._weights: dict[tuple[int, int], Tensor] = {}  # by the number of halvings and the index of the view
        self._bytes_left = CACHE_BYTES
        self._levels = [views]
        while views and all(view.lens is None and view.width >= 2 * MIN_WIDTH for view in views):
            views = [halved(view) for view in views]
            self._levels.append(views)

    def halvings(self, progress: float) -> int:
        """Return how often views are halved in a step that ends at a share of the run in (0, 1]."""
        if progress >= self._coarse_share:
            return 0
        return min(math.ceil(math.log2(self._coarse_share / progress)), len(self._levels) - 1)

    def at(self, index: int, progress: float = 1.0) -> tuple[View, Target]:
        """Return view `index` and its target in such a step; an unusable image or mask is a ValueError."""
        level = self.halvings(progress)
        view = self._levels[level][index]
        image, weight = image_of(view, self._device), self._weights.get((level, index))
        if weight is None:
            weight = weight_of(view, self._weight, self._device)
            if weight.nbytes <= self._bytes_left:
                self._bytes_left -= weight.nbytes
                self._weights[level, index] = weight
        return view, Target(image, weight, depth_of(view, self._device) if self._depth else None)


def image_of(view: View, device: Device = "cpu") -> Tensor:
    """Return the image [H, W, 3] of a view, in [0, 1]; ValueError if there is none, or one of another size."""
    return _checked_size(view, "image", view.image(device=device))


def depth_of(view: View, device: Device = "cpu") -> Tensor | None:
    """Return the depth map [H, W] of a view, world units, or None; one of another size is a ValueError."""
    return None if view.load_depth is None else _checked_size(view, "depth map", view.load_depth().to(device).float())


def weight_of(view: View, weight: str, device: Device = "cpu") -> Tensor:
    """Return the weight of the pixels of a view, [H, W], or [H, 1] without a mask; `weight` is in `ROW_WEIGHTS`.

    For other cameras than panoramas, solid_angle is that of each pixel, at most about 1, and all others are uniform.
    """
    mask, is_panorama = view.mask(device=device), isinstance(view.camera, Panorama)
    mask = None if mask is None else _checked_size(view, "mask", mask)
    try:
        rows = losses.pixel_weight(weight if is_panorama else "uniform", view.height, mask, device=device)
    except ValueError as error:
        raise ValueError(f"view {view.name!r}: {error}") from error
    if is_panorama or weight != "solid_angle":
        return rows
    return rows * (pixel_solid_angles(view.camera) * view.camera.focal**2).to(rows)


def even_weight(view: View, device: torch.device) -> Tensor:
    """Return the weight [H, W] or [H, 1] by solid angle for panoramas, and uniform for other views."""
    return weight_of(view, "solid_angle" if isinstance(view.camera, Panorama) else "uniform", device)


def _checked_size(view: View, what: str, pixels: Tensor) -> Tensor:
    height, width = pixels.shape[:2]
    if (height, width) != (view.height, view.width):
        raise ValueError(f"{what} of view {view.name!r} is {width}x{height}; the view is {view.width}x{view.height}")
    return pixels


def halved(view: View) -> View:
    """Return a panorama at half the width and height, each pixel the mean of those that it covers and no mask hides."""
    width, height, mask, depth = view.width // 2, view.height // 2, view.load_mask, view.load_depth

    def mean(image: Tensor) -> Tensor:
        return interpolate(image.permute(2, 0, 1)[None], (height, width), mode="area")[0].permute(1, 2, 0)

    def small_mask(mask: Callable[[], Tensor]) -> Tensor:
        return mean(mask()[..., None])[..., 0].contiguous()

    def small_pixels(pixels: Callable[[], Tensor]) -> Tensor:
        image = pixels().float()
        small = mean(image)
        if mask is not None:
            visible = mask()[..., None].to(image)
            share = mean(visible)
            small = torch.where(share > 0, mean(image * visible) / share.clamp(min=1e-6), small)
        return small.round().to(torch.uint8).contiguous()

    return replace(
        view,
        width=width,
        height=height,
        load_pixels=view.load_pixels and partial(small_pixels, view.load_pixels),
        load_mask=mask and partial(small_mask, mask),
        load_depth=depth and (lambda: interpolate(depth()[None, None], (height, width))[0, 0]),
    )


class TrainingViews:
    """The training views of a scene with their targets, one after the other, in random order without replacement.

    A view with a `share` below 1 is left out of as many passes, at random. Photographs follow each other, so that
    as many as show the whole sphere make one iteration.
    """

    def __init__(
        self,
        scene: Scene,
        weight: str = "uniform",
        device: Device = "cpu",
        coarse_share: float = 0.0,
        seed: int = 0,
        held_out: Collection[int] = (),
        *,
        depth: str = "",
    ) -> None:
        """Shuffle the views, except those `held_out` until `include_held_out`; other arguments as in `Targets`."""
        self._scene, self._held_out = scene, tuple(held_out)
        self.targets = Targets(scene.train, weight, device, coarse_share, depth=depth)
        self.halvings = self.targets.halvings
        self._generator = torch.Generator().manual_seed(seed)
        self._order = self._shuffled()  # of this epoch
        self._position = 0

    def next(self, progress: float) -> tuple[int, View, Target]:
        """Return index, view and target of the next step, which ends at a share of the run; prefetch the one after."""
        if self._position == len(self._order):
            self._order = self._shuffled()
            self._position = 0
        index = int(self._order[self._position])
        self._position += 1
        # At the end of an epoch the next order is unknown, and the present view is prefetched.
        upcoming = int(self._order[min(self._position, len(self._order) - 1)])
        self._scene.train[upcoming].prefetch()
        return index, *self.targets.at(index, progress)

    def fits(self, room: float) -> bool:
        """Return whether the next view shows at most `room`, a multiple of the sphere."""
        ended = self._position == len(self._order)
        return (1.0 if ended else self._scene.train[int(self._order[self._position])].sphere_share) < room + SLACK

    def include_held_out(self) -> None:
        """Include the views held out in the rest of this epoch, in random order, and in those after it."""
        if self._held_out:
            done, left = self._order[: self._position], self._order[self._position :]
            left = torch.cat((left, torch.tensor(self._held_out)))
            left = left[torch.randperm(len(left), generator=self._generator)]
            self._order = torch.cat((done, left))
            self._held_out = ()

    def _shuffled(self) -> Tensor:
        indices = [index for index in range(len(self._scene.train)) if index not in self._held_out]
        order = torch.tensor(indices)[torch.randperm(len(indices), generator=self._generator)]
        shares = torch.tensor([self._scene.train[index].share for index in order.tolist()])
        if not (shares == 1).all():
            drawn = torch.tensor([False])
            while not drawn.any():
                drawn = torch.rand(len(order), generator=self._generator) < shares
            order = order[drawn]
        return self._with_spheres_of_photographs(order)

    def _with_spheres_of_photographs(self, order: Tensor) -> Tensor:
        """Return the order with photographs together that show about the whole sphere, for one iteration."""
        groups: list[list[int]] = []
        room = 0.0
        for index in order.tolist():
            share = self._scene.train[index].sphere_share
            if share == 1:
                groups.append([index])
                continue
            if share > room + SLACK:
                groups.append(together := [])
                room = 1.0
            together.append(index)
            room -= share
        return torch.tensor([index for group in groups for index in group])

    def state(self) -> State:
        """Return all that decides the views to come; not copies."""
        values = {"position": self._position, "held_out": list(self._held_out), "views": len(self._scene.train)}
        return State({"random/views": self._generator.get_state(), "order": self._order}, values)

    def load(self, state: State) -> None:
        """Resume where the whole state was taken; ValueError if it is of a run with other views."""
        if (views := state.values["views"]) != len(self._scene.train):
            raise ValueError(
                f"the state is of a run with {views} training views, but scene {self._scene.name!r} has "
                f"{len(self._scene.train)}; resume with the data it was trained on"
            )
        self._generator.set_state(state.tensors["random/views"].cpu())
        self._order = state.tensors["order"].to("cpu", copy=True)
        self._position, self._held_out = state.values["position"], tuple(state.values["held_out"])
