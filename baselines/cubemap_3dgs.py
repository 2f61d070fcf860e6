"""Ordinary 3DGS on the faces of a cube: what most people do with a 360 degree camera today.

Each training panorama becomes six perspective views of 90 degrees, each a view of its own. Test panoramas stay whole:
they are drawn face by face and put together (`padgs.render.cubemap`).
"""

from __future__ import annotations

from collections.abc import Iterator

from torch import Tensor

from padgs.data.perspectives import perspective_scene, square_lens
from padgs.learning.method import Budget, Record, RenderConfig
from padgs.render.cubemap import FACES
from padgs.scene import Scene
from padgs.sphere.camera import Panorama, Pinhole
from padgs.splats.method import SplatMethod, refuse_polar_threshold


class Cubemap3DGSMethod(SplatMethod):
    """See `padgs.learning.method.Method`."""

    RENDER = RenderConfig(projection="pinhole", cubemap=True)

    def fit(self, scene: Scene, budget: Budget) -> Iterator[Record]:
        """Train on what is cut out of the panoramas; an iteration is one such view.

        Raises:
            ValueError: a training view is no panorama, or held-out panoramas could not be drawn, or pixels shall be
                weighted, or Gaussians chosen, by a latitude that they do not have.
        """
        if self._render.projection == "pinhole" and not self._render.cubemap:
            raise ValueError(
                "projection pinhole cannot draw the held-out panoramas at once; set render.cubemap=true, or "
                "render.projection=tangent or ray"
            )
        if self._train.weight != "uniform":
            raise ValueError(
                f"train.weight is {self._train.weight}, but the rows of perspective views have no latitude; set uniform"
            )
        refuse_polar_threshold(self._options, "perspective views have no poles")
        yield from super().fit(perspective_scene(scene, self.turns(), self.lens), budget)

    def turns(self) -> Tensor:
        """Rotations [K, 3, 3] from a panorama's camera frame to those of the views."""
        return FACES

    def lens(self, panorama: Panorama) -> Pinhole:
        """The camera of the views; together they see every direction once."""
        return square_lens(panorama, tangent=1.0)
