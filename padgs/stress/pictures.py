"""What is wrong with the panoramas. Each is `(scene, level, random) -> scene`.

Where the world itself is another (`bleached`), or its cameras are (`rolled`, `pitched`), test views are so too; what
went wrong while taking pictures is in training views alone. Pixels are changed whenever they are asked for, so a
stressed run is slower than its rest: its times mean nothing.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from padgs.geometry.panorama import continued, project, rays, sample, sample_sharply
from padgs.scene import Scene, View
from padgs.stress.worlds import facing, of_all, of_training

SECTORS = 8  # colours of what stands under the camera
BLUR = 16  # a pixel loses what sets it apart from the mean of a square with a side of 1 / BLUR of the width


@dataclass(frozen=True)
class Changed:
    """Pixels of a view, and what is done to them when they are asked for."""

    source: Callable[[], Tensor]
    change: Callable[[Tensor], Tensor]

    def __call__(self) -> Tensor:
        """The changed pixels."""
        return self.change(self.source())

    def prefetch(self) -> None:
        """Have the source start, where it can."""
        start = getattr(self.source, "prefetch", None)
        if start is not None:
            start()


def rolled(scene: Scene, degrees: float | None, random: np.random.Generator) -> Scene:
    """All cameras turn about their vertical by whole pixels, each by any angle where `degrees` is None: other things
    lie on the seam, and nothing else changes.
    """

    def roll(view: View) -> View:
        from scipy.spatial.transform import Rotation

        columns = round(view.width * (random.random() if degrees is None else degrees / 360))
        angle = 360 * columns / view.width
        turn = Rotation.from_rotvec((0, angle, 0), degrees=True).as_matrix()

        def shift(pixels: Tensor) -> Tensor:
            return pixels.roll(columns, dims=1)

        return repainted(facing(panorama(view), torch.from_numpy(turn)), shift, shift, shift)

    return of_all(scene, roll)


def pitched(scene: Scene, degrees: float, random: np.random.Generator) -> Scene:
    """All cameras look down by so much: what was at the horizon comes to the poles."""
    from scipy.spatial.transform import Rotation

    turn = torch.from_numpy(Rotation.from_rotvec((degrees, 0, 0), degrees=True).as_matrix())

    def pitch(view: View) -> View:
        before = rays(view.width, view.height) @ turn.float()  # where each pixel looked

        def colors(pixels: Tensor) -> Tensor:
            return sample_sharply(pixels, before.to(pixels.device)).clamp(0, 255).round().to(torch.uint8)

        def weights(mask: Tensor) -> Tensor:
            return sample(mask[..., None], before.to(mask.device))[..., 0]

        def nearest(depth: Tensor) -> Tensor:
            column, row = project(before, view.width, view.height).long().unbind(-1)
            return depth[row.clamp(max=view.height - 1), column % view.width]

        return repainted(facing(panorama(view), turn), colors, weights, nearest)

    return of_all(scene, pitch)


def bleached(scene: Scene, share: float, random: np.random.Generator) -> Scene:
    """That share of all fine contrast is gone, as of bare walls."""

    def fade(pixels: Tensor) -> Tensor:
        radius = max(1, pixels.shape[1] // BLUR // 2)
        fine = pixels.float()
        coarse = _pooled(continued(fine, radius), 2 * radius + 1, stride=1)
        return fine.lerp(coarse, share).round().to(torch.uint8)

    return of_all(scene, lambda view: repainted(panorama(view), fade))


def exposed(scene: Scene, doublings: float, random: np.random.Generator) -> Scene:
    """The stored values of each training view are 2^e times what they were, e uniform in [-doublings, doublings]; in
    sRGB that is about 2e stops of light.
    """

    def expose(view: View) -> View:
        factor = 2 ** random.uniform(-doublings, doublings)
        return repainted(view, lambda pixels: (pixels.float() * factor).clamp(0, 255).round().to(torch.uint8))

    return of_training(scene, expose)


def accompanied(scene: Scene, share: float, random: np.random.Generator) -> Scene:
    """Somebody under the camera, of other colours in each training view, hides the lowest rows."""

    def hide(view: View) -> View:
        colors = torch.from_numpy(random.integers(0, 256, (SECTORS, 3), np.uint8))

        def stand(pixels: Tensor) -> Tensor:
            rows, columns = max(1, round(share * pixels.shape[0])), torch.arange(pixels.shape[1])
            sectors = colors[columns * SECTORS // pixels.shape[1]].to(pixels.device)
            return torch.cat((pixels[:-rows], sectors.expand(rows, -1, -1)))

        return repainted(panorama(view), stand)

    return of_training(scene, hide)


def compressed(scene: Scene, quality: int, random: np.random.Generator) -> Scene:
    """Training views as a JPEG of that quality leaves them."""

    def squeeze(pixels: Tensor) -> Tensor:
        file = io.BytesIO()
        Image.fromarray(pixels.cpu().numpy()).save(file, "JPEG", quality=quality)
        return torch.from_numpy(np.array(Image.open(file))).to(pixels.device)

    return of_training(scene, lambda view: repainted(view, squeeze))


def noisy(scene: Scene, sigma: float, random: np.random.Generator) -> Scene:
    """Each channel of each pixel of the training views is off by a normal deviate, as in little light.

    Args:
        scene, random: as everywhere here.
        sigma: standard deviation, as a share of white.
    """

    def spoil(view: View) -> View:
        seed = int(random.integers(2**63))  # the same noise whenever the view is asked for

        def add(pixels: Tensor) -> Tensor:
            deviates = np.random.default_rng(seed).standard_normal(tuple(pixels.shape), np.float32)
            off = 255 * sigma * torch.from_numpy(deviates).to(pixels.device)
            return (pixels.float() + off).clamp(0, 255).round().to(torch.uint8)

        return repainted(view, add)

    return of_training(scene, spoil)


def shrunk(scene: Scene, factor: int, random: np.random.Generator) -> Scene:
    """Training views have so many times fewer pixels on a side than test views.

    Raises:
        ValueError: a view cannot be divided so.
    """

    def shrink(view: View) -> View:
        if view.width % (2 * factor) or view.height % factor:
            raise ValueError(
                f"view {view.name!r} is {view.width}x{view.height}, which 1/{factor} of its pixels on a side do not "
                "make; set data.width to a multiple of 16"
            )

        def pool(pixels: Tensor) -> Tensor:
            return _pooled(pixels.float(), factor, stride=factor).round().to(torch.uint8)

        def pool_mask(mask: Tensor) -> Tensor:
            return _pooled(mask[..., None], factor, stride=factor)[..., 0]

        size = {"width": view.width // factor, "height": view.height // factor, "load_depth": None}
        return replace(repainted(panorama(view), pool, pool_mask), **size)

    return of_training(scene, shrink)


def repainted(
    view: View,
    pixels: Callable[[Tensor], Tensor],
    mask: Callable[[Tensor], Tensor] | None = None,
    depth: Callable[[Tensor], Tensor] | None = None,
) -> View:
    """The view with its pixels changed, and its mask and depth where they have to go along."""
    changes = {"load_pixels": pixels, "load_mask": mask, "load_depth": depth}
    loads = {name: (getattr(view, name), change) for name, change in changes.items() if change is not None}
    return replace(view, **{name: Changed(*pair) for name, pair in loads.items() if pair[0] is not None})


def panorama(view: View) -> View:
    """The view, if it is a panorama.

    Raises:
        ValueError: it is not.
    """
    if view.lens is not None:
        raise ValueError(f"view {view.name!r} is no panorama, and this condition is made for panoramas")
    return view


def _pooled(pixels: Tensor, side: int, stride: int) -> Tensor:
    """Means [H', W', C] of squares of [H, W, C]."""
    return torch.nn.functional.avg_pool2d(pixels.movedim(-1, 0)[None], side, stride)[0].movedim(0, -1)
