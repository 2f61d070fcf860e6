"""3DGS (Kerbl et al. 2023) on perspective views cut from the panoramas: cube faces, or overlapping crops of one lens.

Test panoramas are rendered face by face (`padgs.render.cubemap`). An iteration trains on as many views as cover the
sphere once, like an iteration of a panoramic method. Crops look along the vertices of an icosahedron, none along the
vertical axis of the panorama; they overlap, so that every direction is inside some crop.
"""

import math
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from typing import ClassVar

from torch import Tensor

from padgs.data.perspectives import looking_at, perspective_scene, solid_angle, square_lens
from padgs.geometry.camera import Panorama, Pinhole
from padgs.methods.splats.method import SplatMethod
from padgs.methods.splats.model import SplatModel
from padgs.render import RenderConfig, RenderOptions
from padgs.render.contract import check_camera
from padgs.render.cubemap import FACES, FINENESS
from padgs.scene import Scene, View
from padgs.training.corrections import GIVEN
from padgs.training.loop import Record, Stage, Trainer
from padgs.training.model import Model
from padgs.training.options import Budget

GOLDEN = (1 + math.sqrt(5)) / 2
CORNERS = [(a, b) for a in (1.0, -1.0) for b in (GOLDEN, -GOLDEN)]
ICOSAHEDRON = [vertex for a, b in CORNERS for vertex in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))]
# Degrees across each square crop. Below 74.75, twice the angle between a vertex and the centre of a face, crops would
# not cover the sphere.
FIELD_OF_VIEW = 75.0


def cut_view_options(options: RenderOptions) -> RenderOptions:
    """Return the renderer options for views cut from panoramas with these options."""
    return replace(options, cubemap=False).on_finer_pixels(FINENESS)


class CutModel(SplatModel):
    """Splats that train on views cut from panoramas, with finer pixels."""

    def render_options(self, view: View) -> RenderOptions:
        """Return the renderer options for a view; filters of cut views keep the size of the panorama's pixels."""
        options = super().render_options(view)
        return options if isinstance(view.camera, Panorama) else cut_view_options(options)


class Cubemap3DGSMethod(SplatMethod):
    """3DGS on the faces of a cube; see `padgs.training.method.Method`."""

    MODEL = CutModel
    CUT_FINENESS = FINENESS
    RENDER = RenderConfig(projection="pinhole", cubemap=True)
    TURNS: ClassVar[Tensor] = FACES  # [K, 3, 3] from the camera frame of a panorama to those of the views
    SLOPE: ClassVar[float] = 1.0  # tan(field of view / 2); together the views cover every direction
    _views_per_step = 1  # cut views that cover the directions of a panorama once on average, for the scene of `fit`

    def fit(self, scene: Scene, budget: Budget, *, stage: Stage = nullcontext) -> Iterator[Record]:
        """Train on views cut from the panoramas; an iteration covers the sphere once."""
        cut = perspective_scene(scene, self.TURNS, self.lens)
        if scene.train:  # `Method.fit` refuses others
            lens = self.lens(Panorama(scene.train[0].width, scene.train[0].height))
            times_seen = len(self.TURNS) * solid_angle(lens) / (4 * math.pi)
            self._views_per_step = max(1, round(len(cut.train) / len(scene.train) / times_seen))
        return super().fit(cut, budget, stage=stage)

    def refuse_search(self) -> None:
        """Refuse: a panorama that is held out would be cut into views, of which most are trained on."""
        raise ValueError("views are cut from all panoramas: none can be held out for the search; take another method")

    def _refuse_impossible(self) -> None:
        if self.render_config.projection == "pinhole" and not self.render_config.cubemap:
            raise ValueError(
                "projection pinhole cannot draw the held-out panoramas at once; set render.cubemap=true, or "
                "render.projection=tangent or ray"
            )
        if self.train_options.weight != "uniform":
            weight = self.train_options.weight
            raise ValueError(f"train.weight is {weight}, but perspective views have no latitude; set uniform")
        if self.train_options.depth_weight:
            raise ValueError("train.depth_weight is not 0, but views that are cut from panoramas have no depth; set 0")
        for learned in ("exposures", "poses", "lens"):
            if (choice := getattr(self.train_options, learned)) != GIVEN:
                raise ValueError(
                    f"train.{learned} is {choice}, but each of the views that are cut from one photograph would learn "
                    f"its own; leave it at {GIVEN}, or take omnigs"
                )
        super()._refuse_impossible()
        check_camera(self.lens(Panorama(8, 4)), cut_view_options(self.render_config.options(scene_scale=1.0)))

    def lens(self, panorama: Panorama) -> Pinhole:
        """Return the camera of the views."""
        return square_lens(panorama, self.SLOPE, FINENESS)

    def build_trainer(self, model: Model, scene: Scene, budget: Budget, stage: Stage) -> Trainer:
        each = self._views_per_step
        return Trainer(model, scene, budget, self.train_options, self.seed, views_each=each, stage=stage)


class Crops3DGSMethod(Cubemap3DGSMethod):
    """The same on twelve overlapping crops; see `Cubemap3DGSMethod`."""

    TURNS = looking_at(ICOSAHEDRON)
    SLOPE = math.tan(math.radians(FIELD_OF_VIEW / 2))

    def refuse_budget(self, budget: Budget) -> None:
        super().refuse_budget(budget)
        if budget.stop == "auto":
            raise ValueError("budget.stop is auto, but other crops overlap those that would be held out; set it to end")
