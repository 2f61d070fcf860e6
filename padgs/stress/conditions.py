"""All conditions, by name: what each changes, and how much at levels 1, 2 and 3."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from padgs.scene import Scene
from padgs.stress import clouds, pictures, worlds
from padgs.training.budget import Budget
from padgs.training.schedule import Pace

LEVELS = (0, 1, 2, 3)  # 0: nothing is changed, the rest that the others are compared with
T = TypeVar("T", bound=Any)


@dataclass(frozen=True)
class Condition:
    """One way in which a capture or its training is out of the ordinary.

    Exactly one of `scene`, `training`, `budget` and `option` is what it does, given the value of a level.
    """

    what: str  # with {} for the value of the level
    levels: tuple[Any, ...]  # mild first; three, or fewer where there is nothing worse
    scene: Callable[[Scene, Any, np.random.Generator], Scene] | None = None
    training: Callable[[Any, Any], Any] | None = None  # (a `TrainConfig`, value) -> another one
    budget: Callable[[Budget, Scene, Any], Budget] | None = None
    option: str | None = None  # of the method that has the value then; to a method without it nothing happens

    def says(self, level: int) -> str:
        """What it is at a level from 1 on."""
        value = self.levels[level - 1]
        return self.what.format("any angle" if value is None else value)


def longer(train: T, factor: int) -> T:
    """The same training, so many times as long."""
    return replace(train, iterations=factor * train.iterations)


def faster(train: T, factor: float) -> T:
    """The same training with all learning rates so many times as large."""
    return replace(train, learning_rates=factor * Pace.of(train.learning_rates, train.iterations).factor)


def slower(train: T, factor: float) -> T:
    """The same training with all learning rates so many times as small."""
    return faster(train, 1 / factor)


def capped(budget: Budget, scene: Scene, share: float) -> Budget:
    """The same budget, for a model of at most that share of the pixels of a training view."""
    view = scene.train[0]
    return replace(budget, gaussians=max(1, round(share * view.width * view.height)))


CONDITIONS: Mapping[str, Condition] = {
    "world_rotation": Condition("the world is turned by {} degrees about a tilted axis", (15, 45, 90), worlds.turned),
    "seam": Condition("all cameras turn about their vertical by {} degrees", (90, 180, None), pictures.rolled),
    "pitch": Condition("all cameras look down by {} degrees", (30, 60, 90), pictures.pitched),
    "world_scale": Condition("all lengths are {} times what they were", (0.1, 10, 100), worlds.scaled),
    "world_offset": Condition("the world is {:g} units away from its origin", (1e2, 1e4, 1e6), worlds.moved_away),
    "near_points": Condition("{:.0%} of the points hang before the cameras", (0.01, 0.05, 0.1), clouds.in_the_face),
    "few_points": Condition("{:.1%} of the points are left", (0.1, 0.01, 0.001), clouds.sparse),
    "random_points": Condition("the points are random: {}", ("box", "sphere", "shell"), clouds.made_up),
    "outlier_points": Condition("{:.0%} of the points are far away", (0.01, 0.05, 0.2), clouds.strays),
    "pose_noise": Condition("training cameras are {:.1%} of the median depth off", (0.001, 0.005, 0.02), worlds.shaken),
    "pose_rotation": Condition("training cameras are twisted by {} degrees", (0.05, 0.2, 1.0), worlds.twisted),
    "few_views": Condition("one of {} training views is left", (2, 4, 8), worlds.thinned),
    "textureless": Condition("{:.0%} of the fine contrast is gone", (0.5, 0.8, 0.95), pictures.bleached),
    "exposure": Condition("training views are up to 2^{} times brighter or darker", (0.25, 0.5, 1.0), pictures.exposed),
    "nadir": Condition("somebody hides the lowest {:.0%} of the rows", (0.03, 0.06, 0.15), pictures.accompanied),
    "resolution": Condition("training views have 1/{} of the pixels on a side", (2, 4, 8), pictures.shrunk),
    "capacity": Condition("there may be {:.0%} as many Gaussians as pixels of a view", (0.5, 0.2, 0.05), budget=capped),
    "schedule": Condition("training is {} times as long", (2, 4, 8), training=longer),
    "learning_rates": Condition("all learning rates are {} times as large", (3, 10, 30), training=faster),
    "low_rates": Condition("all learning rates are 1/{} as large", (3,), training=slower),
    # 11 bits of each factor, then 8; there is no coarser type that networks are trained in
    "precision": Condition("PaD-GS's networks, if any, multiply in {}", ("float16", "bfloat16"), option="precision"),
    "jpeg": Condition("training views are JPEGs of quality {}", (90, 70, 40), pictures.compressed),
    "noise": Condition("training views have noise of {:.0%} of white", (0.02, 0.05, 0.1), pictures.noisy),
}
