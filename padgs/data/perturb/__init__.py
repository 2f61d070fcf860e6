"""Conditions of the stress suite: functions scene -> scene that do what goes wrong with captures, at three levels.

A condition is a function of `geometry` or `images` with the decorator `condition`, which has levels, limits and text.
"""

import zlib
from dataclasses import dataclass, replace

import numpy as np

from padgs.checks import check_known
from padgs.data.perturb import geometry, images  # noqa: F401 - they register their conditions
from padgs.data.perturb.condition import CONDITIONS
from padgs.scene import Scene

NONE = "none"
LEVELS = (0, 1, 2, 3)  # 0: unperturbed


@dataclass(frozen=True)
class StressOptions:
    """The `stress` group of the configuration: a condition and its level. `seed` decides all that is random in it.

    >>> StressOptions("few_views", 2).title, StressOptions("few_views", 0).title
    ('few_views 2', '')
    """

    condition: str = NONE  # none, or a fault of captures such as pose_noise: docs/robustness.md
    level: int = 1  # from 1, mild, to 3, severe; 0: unperturbed

    def __post_init__(self) -> None:
        check_known(self, condition=(NONE, *CONDITIONS))
        if self.level not in LEVELS:
            raise ValueError(f"unknown level {self.level}; known: {', '.join(map(str, LEVELS))}")

    @property
    def title(self) -> str:
        """Condition and level; empty if nothing is perturbed."""
        return "" if self.condition == NONE or self.level == 0 else f"{self.condition} {self.level}"

    def apply(self, scene: Scene, seed: int) -> Scene:
        """Return the perturbed scene, with a note; a ValueError if the condition cannot be applied to it."""
        if not self.title:
            return scene
        condition = CONDITIONS[self.condition]
        random = np.random.default_rng((seed, zlib.crc32(self.condition.encode())))
        value = condition.levels[self.level - 1]
        scene = condition.change(scene, value, random)
        return replace(scene, notes=(*scene.notes, f"stress: {condition.text.format(value)}"))
