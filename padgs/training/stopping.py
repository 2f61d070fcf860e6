"""When a run has had enough: views that are set apart from its gradients stop gaining.

A run that is stopped, by itself or by a person, does not end at once. It jumps to the last `FADE` of its schedule, in
which learning rates fade and averages form, and ends like any other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch

from padgs.render import Rendering
from padgs.scene import View
from padgs.training.targets import even_weight, image_of

APART, FEWEST = 8, 3  # one training view of so many is set apart, but so many at least; and as many must be left
FADE = 0.15  # share of the schedule, at its end, that a stopped run still goes through
GAIN = 0.02  # dB, less than which ...
PATIENCE = 0.05  # ... within this share of the schedule is none
EVERY = 0.01  # share of the schedule between two measurements
SETTLED = 0.01  # share of its parts, by which a model that is neither growing nor thinned out may still change
BEST = 1e-10  # mean square error that is as good as none: 100 dB


def set_apart(views: Sequence[View]) -> tuple[int, ...]:
    """Numbers of training views, evenly spread, that a model is measured on and not trained on.

    Raises:
        ValueError: there are too few for both.
    """
    count = max(FEWEST, len(views) // APART)
    if len(views) < count + FEWEST:
        raise ValueError(
            f"{len(views)} training views leave no calibration views: {FEWEST} are measured on and as many trained on; "
            f"it takes {2 * FEWEST}"
        )
    return tuple(int((number + 0.5) * len(views) / count) for number in range(count))


@torch.no_grad()
def quality(render: Callable[[View], Rendering], views: Sequence[View]) -> float:
    """Mean WS-PSNR of some views, dB, at most 100; plain PSNR of views that are no panoramas."""
    total = 0.0
    for view in views:
        image = render(view).image.clamp(0, 1)
        error = (image - image_of(view, image.device)).square().mean(-1)
        weight = even_weight(view, image.device).expand_as(error)
        total -= 10 * math.log10(max(BEST, ((error * weight).sum() / weight.sum()).item()))
    return total / len(views)


class Plateau:
    """A moving average of the quality of a run, which says when it gains nothing any more.

    `state` holds all that it remembers, as JSON can.
    """

    def __init__(self, iterations: int) -> None:
        """Nothing was measured yet; `iterations` are those of the schedule."""
        self._every = max(1, round(EVERY * iterations))
        self.state: dict[str, Any] = {"next": self._every, "averages": [], "parts": []}

    def is_due(self, moment: int) -> bool:
        """Whether it is time to measure, at an iteration of the schedule."""
        return moment >= self.state["next"]

    def reached(self, value: float, parts: int, moment: int) -> bool:
        """Take in what was measured, dB, of a model of so many parts; whether the average gains next to nothing.

        Not while parts come and go: what has just multiplied, or lost those that are least missed, is worse before it
        is better.
        """
        span = round(PATIENCE / EVERY)
        averages, counts = self.state["averages"][-span:], [*self.state["parts"][-span:], parts]
        averages = [*averages, averages[-1] + (value - averages[-1]) / span if averages else value]
        self.state = {"next": moment + self._every, "averages": averages, "parts": counts}
        is_settled = max(counts) - min(counts) <= SETTLED * parts
        return len(averages) > span and is_settled and averages[-1] - averages[0] < GAIN
