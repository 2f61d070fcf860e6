"""Stress conditions: functions scene -> scene with a name, three levels and the sentence of the docs."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from padgs.scene import Scene

Change = Callable[[Scene, Any, np.random.Generator], Scene]


@dataclass(frozen=True)
class Condition:
    """A condition with the arguments of its decorator."""

    change: Change
    text: str  # what it does; {} is the value of a level
    levels: tuple[Any, ...]  # values of levels 1, 2 and 3, from mild to severe
    test_views: bool = False  # whether test views change too
    # Robustness limits: `metric` of the protocol stability may be that much worse at a level than without the
    # condition, or at most that large where it is an error (seam, depth_error); for 256x128 and 1500 iterations.
    allowed: tuple[float, ...] = ()
    metric: str = "ws_psnr"

    def row(self) -> tuple[str, ...]:
        """Return the cells of the docs' table: the text with a gap for the value, and the values of all levels."""
        (field,) = re.findall(r"{.*?}", self.text)
        return (self.text.replace(field, "…"), *(field.format(value) for value in self.levels))


CONDITIONS: dict[str, Condition] = {}


def condition(text: str, *levels: Any, **fields: Any) -> Callable[[Change], Change]:
    """Register a function (scene, value of the level, random) -> scene as a condition with its name."""

    def register(change: Change) -> Change:
        CONDITIONS[change.__name__] = Condition(change, text, levels, **fields)
        return change

    return register
