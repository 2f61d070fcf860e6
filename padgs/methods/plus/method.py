"""padgs_plus: what one gets when the measured facts of this project decide.

Explicit Gaussians, drawn exactly along each ray, that grow in eight rounds by the pull in space, lose in a
ninth those that are least missed, and are kept small as seen from the cameras. No constant is in world units, counts
follow the pixels of the images, and latitude is nowhere a special case. docs/plus.md has the reason for each part; each
is an option with a value that takes it away (`+experiment=plus_ablation`).
"""

from __future__ import annotations

import math

import torch

from padgs.methods.plus.fill import filled
from padgs.methods.plus.options import GROWN_PER_KEPT, PlusOptions
from padgs.methods.plus.rooms import rooms
from padgs.methods.plus.sky import far_gaussians
from padgs.methods.plus.trainee import PlusTrainee, counted_pixels
from padgs.methods.splats.method import SplatMethod, fewest
from padgs.methods.splats.model import Splats
from padgs.methods.splats.trainee import SplatTrainee
from padgs.render import RenderConfig
from padgs.scene import Scene
from padgs.training.loop import Stage, Trainer
from padgs.training.model import Model
from padgs.training.options import Budget, TrainOptions

PIXEL = 0.1  # square pixels; a pixel is the mean over a square, whose variance is 1/12


class PlusMethod(SplatMethod):
    """See `padgs.training.method.Method`."""

    Options = PlusOptions
    TRAINEE = PlusTrainee
    RENDER = RenderConfig(projection="ray", low_pass=PIXEL)
    TRAIN = TrainOptions(weight="solid_angle")

    @property
    def _target(self) -> int | None:
        """As many Gaussians to grow as leave a choice of those that the budget asks for, if it names a number."""
        asked = super()._target
        return asked if asked is None or self.options.removal_psnr is None else GROWN_PER_KEPT * asked

    @property
    def _removal_psnr(self) -> float | None:
        return self.options.removal_psnr or super()._removal_psnr

    @property
    def is_drawn_no_finer(self) -> bool:
        """See `padgs.methods.splats.nearest`; checkpoints of earlier versions do not know the training views."""
        return self.model.is_drawn_no_finer

    _sought: tuple[Scene, int, Scene, torch.Tensor] | None = None  # what `_filled` found last

    def _filled(self, scene: Scene, count: int) -> tuple[Scene, torch.Generator]:
        """The scene with points from its photographs, and the generator of all else that is chosen at random.

        They are sought once for a rehearsal and for its run, and not where the model comes from elsewhere.
        """
        generator = torch.Generator().manual_seed(self.seed)
        if self._loaded_state is not None or self._warm_start_state is not None:
            return scene, generator
        if self._sought is None or self._sought[0] is not scene or self._sought[1] != count:
            self._sought = scene, count, filled(scene, count, generator=generator), generator.get_state()
        generator.set_state(self._sought[3])
        return self._sought[2], generator

    def build_model(self, scene: Scene, iterations: int) -> SplatTrainee:
        """See `Method.build_model`."""
        options, pixels = self.options, rooms(scene) * counted_pixels(scene.train[0])
        start, limit = (_within(share, pixels) for share in (options.start_share, options.limit_share))
        limit = fewest(options.max_gaussians, limit if self._target is None else self._target)
        room = None if limit is None else math.ceil(limit / (1 + options.sky_share))  # for points, if the sky has its
        most, sought = fewest(start, room), round(options.fill_share * pixels)
        points, generator = self._filled(scene, sought if most is None else min(sought, most))
        splats = Splats.from_scene(
            points,
            degree=options.sh_degree,
            max_gaussians=most,
            opacity=options.initial_opacity,
            scale=options.initial_scale,
            generator=generator,
        )
        directions = round(options.sky_share * len(splats))
        directions = directions if limit is None else min(directions, limit - len(splats))
        if directions > 0:
            sky = far_gaussians(scene, directions, degree=options.sh_degree, opacity=options.initial_opacity)
            splats.load({name: torch.cat((own, sky.rows()[name])) for name, own in splats.rows().items()})
        return self._trainee_of(splats, options.extent_of(scene), iterations, scene.train, limit=limit)

    def build_trainer(self, trainee: Model, scene: Scene, budget: Budget, stage: Stage) -> Trainer:
        """See `Method.build_trainer`."""
        share = self.options.coarse_share
        return Trainer(trainee, scene, budget, self.train_options, self.seed, coarse_share=share, stage=stage)


def _within(share: float | None, pixels: float) -> int | None:
    """A share of the pixels as a number; None, which is no limit, stays."""
    return None if share is None else max(1, round(share * pixels))
