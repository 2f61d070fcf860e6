"""Conditions of the images. Each is `(scene, value, random) -> scene`.

Test views change too where the world (`textureless`) or all cameras (`seam`, `pitch`) differ; what goes wrong during
the capture is in training views alone. Pixels are changed at each loading, so the times of such runs mean nothing.
"""

import io
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from padgs.data.perturb.condition import condition
from padgs.data.perturb.geometry import rotate_camera, rotation_about
from padgs.files import open_image
from padgs.geometry.panorama import pad_panorama, project, rays, sample, sample_bicubic
from padgs.scene import Scene, View

SECTORS = 8  # colors of the person under the camera
BLUR = 16  # fine contrast: difference from the mean of a square with a side of 1 / BLUR of the width


@dataclass(frozen=True)
class Changed:
    """A loader of pixels, and the change that is applied to what it loads."""

    source: Callable[[], Tensor]
    change: Callable[[Tensor], Tensor]

    def __call__(self) -> Tensor:
        """Return the changed pixels."""
        return self.change(self.source())

    def prefetch(self) -> None:
        """Start loading in the background if the source can."""
        getattr(self.source, "prefetch", lambda: None)()


@condition(
    "all cameras turn about their vertical, so that the seam lies elsewhere (degrees: {})",
    90,
    180,
    "random",
    test_views=True,
    metric="seam",
    allowed=(1.1, 1.1, 1.1),
)
def seam(scene: Scene, degrees: float | str, random: np.random.Generator) -> Scene:
    """Turn all cameras about their vertical by whole pixels, each by a random angle if `degrees` is "random"."""

    def turn(view: View) -> View:
        columns = round(view.width * (random.random() if isinstance(degrees, str) else degrees / 360))
        rotation = rotation_about((0, 360 * columns / view.width, 0))

        def shift(pixels: Tensor) -> Tensor:
            return pixels.roll(columns, dims=1)

        return change_pixels(rotate_camera(_panorama(view), rotation), shift, shift, shift)

    return scene.with_views(turn)


@condition("all cameras look down by {}°: the horizon moves to the poles", 30, 60, 90, test_views=True)
def pitch(scene: Scene, degrees: float, random: np.random.Generator) -> Scene:
    """Turn all cameras down, so that the horizon moves to the poles."""
    rotation = rotation_about((degrees, 0, 0))

    def turn(view: View) -> View:
        old_rays = rays(view.width, view.height) @ rotation.float()  # in the old camera frame, of each new pixel

        def colors(pixels: Tensor) -> Tensor:
            return _to_bytes(sample_bicubic(pixels, old_rays.to(pixels.device)))

        def weights(mask: Tensor) -> Tensor:
            return sample(mask[..., None], old_rays.to(mask.device))[..., 0]

        def nearest(depth: Tensor) -> Tensor:
            column, row = project(old_rays, view.width, view.height).long().unbind(-1)
            return depth[row.clamp(max=view.height - 1), column % view.width]

        return change_pixels(rotate_camera(_panorama(view), rotation), colors, weights, nearest)

    return scene.with_views(turn)


@condition(
    "{:.0%} of fine contrast is gone", 0.5, 0.8, 0.95, test_views=True, metric="depth_error", allowed=(0.1, 0.15, 0.3)
)
def textureless(scene: Scene, share: float, random: np.random.Generator) -> Scene:
    """Remove a share of all fine contrast, as on bare walls."""

    def fade(pixels: Tensor) -> Tensor:
        radius = max(1, pixels.shape[1] // BLUR // 2)
        fine = pixels.float()
        coarse = _pool(pad_panorama(fine, radius), 2 * radius + 1, stride=1)
        return _to_bytes(fine.lerp(coarse, share))

    return scene.with_views(lambda view: change_pixels(_panorama(view), fade))


@condition(
    "training views are up to 2^{} brighter or darker", 0.25, 0.5, 1.0, metric="ws_psnr_fitted", allowed=(0.5, 1.5, 3.0)
)
def exposure(scene: Scene, doublings: float, random: np.random.Generator) -> Scene:
    """Multiply the stored values of each training view by 2^e, e uniform in [-doublings, doublings]; in sRGB that is
    about 2e stops of light.
    """

    def expose(view: View) -> View:
        factor = 2 ** random.uniform(-doublings, doublings)
        return change_pixels(view, lambda pixels: _to_bytes(pixels.float() * factor))

    return replace(scene, train=tuple(map(expose, scene.train)))


@condition("a person, different in each training view, hides the lowest {:.0%} of the rows", 0.03, 0.06, 0.15)
def nadir(scene: Scene, share: float, random: np.random.Generator) -> Scene:
    """Hide the lowest rows of each training view behind a person in other colors."""

    def hide(view: View) -> View:
        colors = torch.from_numpy(random.integers(0, 256, (SECTORS, 3), np.uint8))

        def stand(pixels: Tensor) -> Tensor:
            rows, columns = max(1, round(share * pixels.shape[0])), torch.arange(pixels.shape[1])
            sectors = colors[columns * SECTORS // pixels.shape[1]].to(pixels.device)
            return torch.cat((pixels[:-rows], sectors.expand(rows, -1, -1)))

        return change_pixels(_panorama(view), stand)

    return replace(scene, train=tuple(map(hide, scene.train)))


@condition("training views are JPEGs of quality {}", 90, 70, 40)
def jpeg(scene: Scene, quality: int, random: np.random.Generator) -> Scene:
    """Compress training views as JPEGs of that quality."""

    def compress(pixels: Tensor) -> Tensor:
        file = io.BytesIO()
        Image.fromarray(pixels.cpu().numpy()).save(file, "JPEG", quality=quality)
        return torch.from_numpy(np.array(open_image(file))).to(pixels.device)

    return replace(scene, train=tuple(change_pixels(view, compress) for view in scene.train))


@condition("training views have Gaussian noise with a standard deviation of {:.0%} of white", 0.02, 0.05, 0.1)
def noise(scene: Scene, sigma: float, random: np.random.Generator) -> Scene:
    """Add normal noise to each channel of the training views; `sigma` is a share of white."""

    def spoil(view: View) -> View:
        seed = int(random.integers(2**63))  # the same noise at each loading

        def add(pixels: Tensor) -> Tensor:
            deviates = np.random.default_rng(seed).standard_normal(tuple(pixels.shape), np.float32)
            return _to_bytes(pixels.float() + 255 * sigma * torch.from_numpy(deviates).to(pixels.device))

        return change_pixels(view, add)

    return replace(scene, train=tuple(map(spoil, scene.train)))


@condition("training views have 1/{} of the width and height", 2, 4, 8, allowed=(2.0,))
def resolution(scene: Scene, factor: int, random: np.random.Generator) -> Scene:
    """Reduce the width and height of training views by a factor that divides them; test views keep theirs."""

    def shrink(view: View) -> View:
        if view.width % (2 * factor) or view.height % factor:
            size = f"{view.width}x{view.height}, which is not divisible by {factor}"
            raise ValueError(f"view {view.name!r} is {size}; set data.width to a multiple of 16")

        def pool(pixels: Tensor) -> Tensor:
            return _pool(pixels.float(), factor, stride=factor).round().to(torch.uint8)

        def pool_mask(mask: Tensor) -> Tensor:
            return _pool(mask[..., None], factor, stride=factor)[..., 0]

        middle = slice(factor // 2, None, factor)
        changed = change_pixels(_panorama(view), pool, pool_mask, lambda depth: depth[middle, middle])
        return replace(changed, width=view.width // factor, height=view.height // factor)

    return replace(scene, train=tuple(map(shrink, scene.train)))


def change_pixels(
    view: View,
    pixels: Callable[[Tensor], Tensor],
    mask: Callable[[Tensor], Tensor] | None = None,
    depth: Callable[[Tensor], Tensor] | None = None,
) -> View:
    """Return the view with its pixels changed, and also its mask and depth if changes for them are given."""
    changes = {"load_pixels": pixels, "load_mask": mask, "load_depth": depth}
    loads = {name: (getattr(view, name), change) for name, change in changes.items() if change is not None}
    return replace(view, **{name: Changed(*pair) for name, pair in loads.items() if pair[0] is not None})


def _panorama(view: View) -> View:
    """Return the view; a ValueError if it is not a panorama."""
    if view.lens is not None:
        raise ValueError(f"view {view.name!r} is not a panorama, but this condition is made for panoramas")
    return view


def _to_bytes(pixels: Tensor) -> Tensor:
    return pixels.clamp(0, 255).round().to(torch.uint8)


def _pool(pixels: Tensor, side: int, stride: int) -> Tensor:
    """Return the means [H', W', C] of squares of [H, W, C]."""
    return torch.nn.functional.avg_pool2d(pixels.movedim(-1, 0)[None], side, stride)[0].movedim(0, -1)
