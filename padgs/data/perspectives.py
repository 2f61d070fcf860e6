"""Perspective views resampled from panoramas, for methods that support pinhole cameras only.

Interpolation is on demand and cached in the panorama's `padgs.data.store`. It is bicubic, which blurs little; near
masked pixels it is bilinear and weighted by the mask, so that masked colours reach no view.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from padgs.data.store import ImageStore, StoredImage
from padgs.geometry.camera import Panorama, Pinhole
from padgs.geometry.panorama import CUBIC_REACH, pad_panorama, sample, sample_bicubic
from padgs.scene import Scene, View


@dataclass(frozen=True, eq=False)  # a key of the store by identity: tensors are neither compared nor hashed by value
class _Resampled:
    """Pixel directions of a view in the frame of its panorama."""

    panorama: View
    rotation: Tensor  # [3, 3]
    lens: Pinhole
    load: Callable[[], Tensor]  # the panorama's pixels, or its mask

    def rays(self, like: Tensor) -> Tensor:
        """Return directions [H, W, 3] in the panorama's frame: d_panorama = rotation^T d_view."""
        return self.lens.rays(dtype=torch.float64, device=like.device) @ self.rotation.to(like.device)


class _Pixels(_Resampled):
    @property
    def store(self) -> ImageStore | None:
        return self.load.store if isinstance(self.load, StoredImage) else None

    def __call__(self) -> Tensor:
        """Return pixels [H, W, 3] uint8; do not modify."""
        return self.decode() if self.store is None else self.store.get(self)

    def decode(self) -> Tensor:
        """Interpolate without the cache."""
        image = self.load()
        rays, mask = self.rays(image), self.panorama.mask(device=image.device)
        colors = sample_bicubic(image, rays)
        if mask is not None:
            mask = mask[..., None]
            weighted = sample(torch.cat((image * mask, mask), dim=-1), rays)
            masked = pad_panorama((mask < 1).float(), CUBIC_REACH).movedim(-1, 0)
            near_masked = max_pool2d(masked, 2 * CUBIC_REACH + 1, stride=1).movedim(0, -1)
            linear = weighted[..., :3] / weighted[..., 3:].clamp(min=1e-6)
            colors = torch.where(sample(near_masked, rays) > 0, linear, colors)
        return colors.clamp(0, 255).round().to(torch.uint8)

    def prefetch(self) -> None:
        """Load the panorama in the background, unless the view is cached."""
        if self.store is None or self not in self.store:
            self.panorama.prefetch()


class _Mask(_Resampled):
    def __call__(self) -> Tensor:
        """Return weights [H, W] in [0, 1]."""
        mask = self.load()[..., None]
        return sample(mask, self.rays(mask))[..., 0]


def perspective_views(panorama: View, rotations: Tensor, lens: Pinhole) -> tuple[View, ...]:
    """Resample perspective views of a lens with the centre of a panorama; another camera is a ValueError.

    `rotations` [K, 3, 3] lead from the panorama's camera frame to the views'; rows are right, down, forward.
    """
    _refuse_photographs(panorama)
    views, pixels, mask = [], panorama.load_pixels, panorama.load_mask
    for number, rotation in enumerate(rotations.double()):
        pose, name = panorama.cam_from_world.clone(), f"{panorama.name}-{number}"
        pose[:3] = rotation.to(pose) @ pose[:3]
        load_pixels = pixels and _Pixels(panorama, rotation, lens, pixels)
        load_mask = mask and _Mask(panorama, rotation, lens, mask)
        views.append(View(name, pose, lens.width, lens.height, load_pixels, load_mask, lens, share=panorama.share))
    return tuple(views)


def _refuse_photographs(*views: View) -> None:
    for view in views:
        if not isinstance(view.camera, Panorama):
            raise ValueError(
                f"view {view.name!r} has a {type(view.camera).__name__} camera; only panoramas can be resampled to "
                "perspective views: leave out photographs with data.cameras=panoramas"
            )


def perspective_scene(scene: Scene, rotations: Tensor, lens: Callable[[Panorama], Pinhole]) -> Scene:
    """Replace each training panorama by perspective views that are not fully masked; test views remain panoramas."""
    views: list[View] = []
    _refuse_photographs(*scene.test)
    for panorama in scene.train:
        cut = perspective_views(panorama, rotations, lens(Panorama(panorama.width, panorama.height)))
        views += [view for view in cut if _is_visible(view)]
    return replace(scene, train=tuple(views))


def _is_visible(view: View) -> bool:
    if not isinstance(view.load_mask, _Mask):
        return True
    lens = view.load_mask.lens
    shrink = min(1.0, 64 / max(lens.width, lens.height))
    width, height = (max(1, round(shrink * side)) for side in (lens.width, lens.height))
    across, down = width / lens.width, height / lens.height
    grid = Pinhole(width, height, across * lens.fx, down * lens.fy, across * lens.cx, down * lens.cy)
    return bool((replace(view.load_mask, lens=grid)() > 0).any())


def square_lens(panorama: Panorama, tangent: float, fineness: float = 1.0) -> Pinhole:
    """Return a square pinhole camera with `tangent` = tan(field of view / 2).

    Its centre has `fineness` times the pixels per radian of the panorama's horizon. The side is rounded to whole
    pixels, and the focal length adapted, so that the field of view is exact.
    """
    side = max(1, round(2 * fineness * panorama.focal * tangent))
    focal = side / 2 / tangent
    return Pinhole(side, side, focal, focal, side / 2, side / 2)


def solid_angle(lens: Pinhole) -> float:
    """Return the solid angle of a square view in steradians: 4 asin(sin^2(fov / 2))."""
    return 4 * math.asin(math.sin(math.atan(lens.width / 2 / lens.fx)) ** 2)


def looking_at(directions: Sequence[Sequence[float]] | Tensor) -> Tensor:
    """Return rotations [K, 3, 3] (rows right, down, forward) without roll that look along [K, 3], none vertical."""
    forward = torch.nn.functional.normalize(torch.as_tensor(directions, dtype=torch.float64), dim=-1)
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(forward)
    right = torch.nn.functional.normalize(torch.linalg.cross(down, forward), dim=-1)
    return torch.stack((right, torch.linalg.cross(forward, right), forward), dim=-2)
