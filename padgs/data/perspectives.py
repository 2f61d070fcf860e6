"""Perspective views cut out of panoramas, for methods that know ordinary cameras only.

Pixels are interpolated when they are asked for, from the panorama as its own loader gives it, and kept where the
panorama's are, within the same bytes (`padgs.data.store`); without such a store nothing is kept. Interpolation is
bicubic, which blurs little. What the panorama's mask ignores colours no pixel of a view: beside it, colours are
interpolated bilinearly, weighted by the mask.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from padgs.data.store import ImageStore, StoredImage
from padgs.geometry.camera import Panorama, Pinhole
from padgs.geometry.panorama import CUBIC_REACH, continued, sample, sample_sharply
from padgs.scene import Scene, View


@dataclass(frozen=True, eq=False)  # a key of the store by identity: tensors are neither compared nor hashed by value
class _Cut:
    """Where the pixels of one view lie in its panorama."""

    panorama: View
    turn: Tensor  # [3, 3]
    lens: Pinhole
    load: Callable[[], Tensor]  # of the panorama's pixels, or its mask

    def rays(self, like: Tensor) -> Tensor:
        """Directions [H, W, 3] in the frame of the panorama, where its pixels are; d_panorama = turn^T d_view."""
        return self.lens.rays(dtype=torch.float64, device=like.device) @ self.turn.to(like.device)


class _Pixels(_Cut):
    """Loads the colours of a view."""

    @property
    def store(self) -> ImageStore | None:
        return self.load.store if isinstance(self.load, StoredImage) else None

    def __call__(self) -> Tensor:
        """Pixels [H, W, 3] uint8; not to be written to."""
        return self.decode() if self.store is None else self.store.get(self)

    def decode(self) -> Tensor:
        """Interpolate, past the cache."""
        image = self.load()
        rays, mask = self.rays(image), self.panorama.mask(device=image.device)
        colors = sample_sharply(image, rays)
        if mask is not None:
            mask = mask[..., None]
            weighted = sample(torch.cat((image * mask, mask), dim=-1), rays)
            hidden = continued((mask < 1).float(), CUBIC_REACH).movedim(-1, 0)
            beside = max_pool2d(hidden, 2 * CUBIC_REACH + 1, stride=1).movedim(0, -1)
            careful = weighted[..., :3] / weighted[..., 3:].clamp(min=1e-6)
            colors = torch.where(sample(beside, rays) > 0, careful, colors)
        return colors.clamp(0, 255).round().to(torch.uint8)

    def prefetch(self) -> None:
        """Have the panorama loaded in the background, where its source can, unless it is not needed any more."""
        if self.store is None or self not in self.store:
            self.panorama.prefetch()


class _Mask(_Cut):
    """Loads the mask of a view."""

    def __call__(self) -> Tensor:
        """Weights [H, W] in [0, 1]."""
        mask = self.load()[..., None]
        return sample(mask, self.rays(mask))[..., 0]


def perspective_views(panorama: View, turns: Tensor, lens: Pinhole) -> tuple[View, ...]:
    """What ordinary cameras at the place of a panorama would have seen.

    Args:
        panorama: a view that sees the whole sphere.
        turns: [K, 3, 3] rotations from the panorama's camera frame to the views'; rows are right, down, forward.
        lens: of all of them.

    Raises:
        ValueError: the view is no panorama.
    """
    if not isinstance(panorama.camera, Panorama):
        raise ValueError(
            f"view {panorama.name!r} is made by a {type(panorama.camera).__name__}; views are cut out of panoramas only"
        )
    views = []
    for number, turn in enumerate(turns.double()):
        pose = panorama.cam_from_world.clone()
        pose[:3] = turn.to(pose) @ pose[:3]
        pixels, mask = panorama.load_pixels, panorama.load_mask
        views.append(
            View(
                f"{panorama.name}-{number}",
                pose,
                lens.width,
                lens.height,
                None if pixels is None else _Pixels(panorama, turn, lens, pixels),
                None if mask is None else _Mask(panorama, turn, lens, mask),
                lens,
            )
        )
    return tuple(views)


def perspective_scene(scene: Scene, turns: Tensor, lens: Callable[[Panorama], Pinhole]) -> Scene:
    """The scene with each training panorama replaced by views cut out of it; test views remain panoramas.

    Views that a mask hides altogether are left out (looked for on a grid of at most 64 x 64 directions).
    """
    views: list[View] = []
    for panorama in scene.train:
        cut = perspective_views(panorama, turns, lens(Panorama(panorama.width, panorama.height)))
        views += [view for view in cut if _shows_something(view)]
    return replace(scene, train=tuple(views))


def _shows_something(view: View) -> bool:
    if not isinstance(view.load_mask, _Mask):
        return True
    lens = view.load_mask.lens
    shrink = min(1.0, 64 / max(lens.width, lens.height))
    width, height = max(1, round(shrink * lens.width)), max(1, round(shrink * lens.height))
    across, down = width / lens.width, height / lens.height
    grid = Pinhole(width, height, across * lens.fx, down * lens.fy, across * lens.cx, down * lens.cy)
    return bool((replace(view.load_mask, lens=grid)() > 0).any())


def square_lens(panorama: Panorama, tangent: float, fineness: float = 1.0) -> Pinhole:
    """A square view that reaches `tangent` = tan(field of view / 2) to each side.

    Its middle has `fineness` times the pixels per radian of the panorama's horizon. The side is rounded to whole pixels
    and the focal length follows, so that the field of view is exact.
    """
    side = max(1, round(2 * fineness * panorama.focal * tangent))
    focal = side / 2 / tangent
    return Pinhole(side, side, focal, focal, side / 2, side / 2)


def solid_angle(lens: Pinhole) -> float:
    """What a square view shows of the sphere, in steradians: 4 asin(sin^2(half its field of view))."""
    return 4 * math.asin(math.sin(math.atan(lens.width / 2 / lens.fx)) ** 2)


def looking_at(directions: Sequence[Sequence[float]] | Tensor) -> Tensor:
    """Rotations [K, 3, 3] (rows right, down, forward) to cameras that look along directions [K, 3], none of them up or
    down, without roll: their right is level.
    """
    forward = torch.nn.functional.normalize(torch.as_tensor(directions, dtype=torch.float64), dim=-1)
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(forward)
    right = torch.nn.functional.normalize(torch.linalg.cross(down, forward), dim=-1)
    return torch.stack((right, torch.linalg.cross(forward, right), forward), dim=-2)
