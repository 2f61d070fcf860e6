"""The `stress` group of the configuration: under which condition a run is made, and how bad that is."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from padgs.checks import check_known
from padgs.scene import Scene
from padgs.stress.conditions import CONDITIONS, LEVELS, Condition
from padgs.training.budget import Budget

T = TypeVar("T")
NONE = "none"


@dataclass(frozen=True)
class StressOptions:
    """A condition at a level. Whatever is random in it follows from the seed of the run.

    A level that a condition does not have is its worst.

    >>> StressOptions("few_views", 2).title, StressOptions("few_views", 0).title, StressOptions("precision", 3).title
    ('few_views 2', '', 'precision 2')
    """

    condition: str = NONE  # a name of `padgs.stress.conditions.CONDITIONS`
    level: int = 1  # from 1, mild, to 3; 0: the condition is not there

    def __post_init__(self) -> None:
        check_known(self, condition=(NONE, *CONDITIONS))
        if self.level not in LEVELS:
            raise ValueError(f"unknown level {self.level}; known: {', '.join(map(str, LEVELS))}")
        if self._condition is not None:  # matrices have the same levels for all: nothing runs twice
            object.__setattr__(self, "level", min(self.level, len(self._condition.levels)))

    @property
    def title(self) -> str:
        """Condition and level; empty where nothing is changed."""
        return f"{self.condition} {self.level}" if self._condition else ""

    @property
    def _condition(self) -> Condition | None:
        return CONDITIONS[self.condition] if self.condition != NONE and self.level > 0 else None

    def scene(self, scene: Scene, seed: int) -> Scene:
        """The scene as the condition leaves it, with a note that says so.

        Raises:
            ValueError: the condition cannot be made of this scene.
        """
        if (condition := self._condition) is None:
            return scene
        if condition.scene is not None:
            random = np.random.default_rng((seed, zlib.crc32(self.condition.encode())))
            scene = condition.scene(scene, condition.levels[self.level - 1], random)
        return replace(scene, notes=(*scene.notes, f"stress: {condition.says(self.level)}"))

    def training(self, train: T) -> T:
        """How it is trained under the condition."""
        condition = self._condition
        if condition is None or condition.training is None:
            return train
        return condition.training(train, condition.levels[self.level - 1])

    def options(self, options: T) -> T:
        """The settings of a method under the condition; as they are where they hold nothing that it sets."""
        condition: Condition | None = self._condition
        if condition is None or condition.option is None or not hasattr(options, condition.option):
            return options
        changed: Any = options
        return replace(changed, **{condition.option: condition.levels[self.level - 1]})

    def budget(self, budget: Budget, scene: Scene) -> Budget:
        """What training may take under the condition."""
        condition = self._condition
        if condition is None or condition.budget is None:
            return budget
        return condition.budget(budget, scene, condition.levels[self.level - 1])
