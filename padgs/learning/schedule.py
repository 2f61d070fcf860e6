"""Learning rates as functions of the iteration, and the groups of parameters that share one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from torch import nn

PUBLISHED_ITERATIONS = 30_000  # the run length that all published schedules are written for


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters that share a learning rate; the name appears in messages and checkpoints."""

    name: str
    parameters: tuple[nn.Parameter, ...]
    learning_rate: Callable[[int], float]  # iteration (1 for the first step) -> learning rate


@dataclass(frozen=True)
class Constant:
    """The same learning rate at every iteration."""

    value: float

    def __call__(self, iteration: int) -> float:
        """Learning rate at an iteration."""
        return self.value


@dataclass(frozen=True)
class LogLinear:
    """exp((1 - t) ln start + t ln end) with t = iteration / steps, and `end` after that.

    >>> decay = LogLinear(1e-2, 1e-4, steps=100)
    >>> round(decay(50), 9), round(decay(1000), 9)
    (0.001, 0.0001)
    """

    start: float
    end: float
    steps: int

    def __post_init__(self) -> None:
        """Reject rates that have no logarithm."""
        if not (self.start > 0 and self.end > 0 and self.steps >= 1):
            raise ValueError(f"{self} has no log-linear decay; both rates must be > 0 and steps >= 1")

    def __call__(self, iteration: int) -> float:
        """Learning rate at an iteration."""
        t = min(max(iteration / self.steps, 0.0), 1.0)
        return math.exp((1 - t) * math.log(self.start) + t * math.log(self.end))


def scaled(published: int, total: int) -> int:
    """A published iteration number, moved to a run of `total` iterations; at least 1.

    All windows and intervals that say *when* something happens follow the run length like this, so that a short run
    goes through the same phases as the published 30 000 iterations.

    >>> scaled(1500, 30_000), scaled(1500, 3_000), scaled(15_000, 30_000)
    (1500, 150, 15000)
    """
    return max(1, round(published * total / PUBLISHED_ITERATIONS))
