"""Conditions of the stress suite: functions scene -> scene that do what goes wrong with captures, at three levels.

To add a condition, add a row to `conditions.yaml` and a function of that name to the module that the row names.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from padgs.checks import check_known
from padgs.scene import Scene

NONE = "none"
LEVELS = (0, 1, 2, 3)  # 0: unperturbed


@dataclass(frozen=True)
class Condition:
    """A row of `conditions.yaml`, which explains the fields."""

    module: str
    text: str
    levels: tuple[Any, Any, Any]
    test_views: bool = False
    metric: str = "ws_psnr"
    allowed: tuple[float, ...] = ()

    def describe(self, level: int) -> str:
        """Return what the condition does at a level from 1 on."""
        return self.text.format(self.levels[level - 1])

    def row(self) -> tuple[str, ...]:
        """Return the cells of the docs' table: the text with a gap for the value, and the values of all levels."""
        (field,) = re.findall(r"{.*?}", self.text)
        return (self.text.replace(field, "…"), *(field.format(value) for value in self.levels))


CONDITIONS: Mapping[str, Condition] = {
    name: Condition(**row)
    for name, row in yaml.safe_load(Path(__file__).with_name("conditions.yaml").read_text("utf-8")).items()
}


@dataclass(frozen=True)
class StressOptions:
    """The `stress` group of the configuration: a condition and its level. `seed` decides all that is random in it.

    >>> StressOptions("few_views", 2).title, StressOptions("few_views", 0).title
    ('few_views 2', '')
    """

    condition: str = NONE  # a name of `CONDITIONS`
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
        """Return the perturbed scene, with a note that says so.

        Raises:
            ValueError: the condition cannot be applied to this scene.
        """
        if not self.title:
            return scene
        condition = CONDITIONS[self.condition]
        change = getattr(import_module(f"padgs.data.perturb.{condition.module}"), self.condition)
        random = np.random.default_rng((seed, zlib.crc32(self.condition.encode())))
        scene = change(scene, condition.levels[self.level - 1], random)
        return replace(scene, notes=(*scene.notes, f"stress: {condition.describe(self.level)}"))
