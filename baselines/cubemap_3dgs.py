"""Ordinary 3DGS on the faces of a cube: what most people do with a 360 degree camera today.

Each training panorama becomes six perspective views of 90 degrees, each a view of its own. Test panoramas stay whole:
they are drawn face by face and put together (`padgs.render.cubemap`).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext

from torch import Tensor

from padgs.data.perspectives import perspective_scene, square_lens
from padgs.learning.loop import Budget, Record, Stage
from padgs.render.config import RenderConfig
from padgs.render.cubemap import FACES
from padgs.scene import Scene
from padgs.sphere.camera import Panorama, Pinhole
from padgs.splats.method import SplatMethod, refuse_polar_threshold


class Cubemap3DGSMethod(SplatMethod):
    """See `padgs.learning.method.Method`."""

    RENDER = RenderConfig(projection="pinhole", cubemap=True)

    def fit(self, scene: Scene, budget: Budget, *, stage: Stage = nullcontext) -> Iterator[Record]:
        """Train on what is cut out of the panoramas; an iteration is one such view.

        Raises:
            ValueError: a training view is no panorama, or held-out panoramas could not be drawn, or pixels shall be
                weighted, or Gaussians chosen, by a latitude that they do not have.
        """
        if self.render_config.projection == "pinhole" and not self.render_config.cubemap:
            raise ValueError(
                "projection pinhole cannot draw the held-out panoramas at once; set render.cubemap=true, or "
                "render.projection=tangent or ray"
            )
        if self.train_options.weight != "uniform":
            raise ValueError(
                f"train.weight is {self.train_options.weight}, but the rows of perspective views have no latitude; "
                "set uniform"
            )
        refuse_polar_threshold(self.options, "perspective views have no poles")
        return super().fit(perspective_scene(scene, self.turns(), self.lens), budget, stage=stage)

    def turns(self) -> Tensor:
        """Rotations [K, 3, 3] from a panorama's camera frame to those of the views."""
        return FACES

    def lens(self, panorama: Panorama) -> Pinhole:
        """The camera of the views; together they see every direction once."""
        return square_lens(panorama, tangent=1.0)
