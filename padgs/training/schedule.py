"""Learning rates as functions of the iteration, and the groups of parameters that share one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor, nn

PUBLISHED_ITERATIONS = 30_000  # length of all published schedules
LEARNING_RATES = ("published", "run", "run_linear")
FASTEST = 8.0  # largest factor on published rates; 9 lost quality in runs of 500 iterations
LINEAR_ITERATIONS = 3000  # shorter runs have faster rates by run_linear
SLOWING_FROM = 0.6  # share of the run after which faster rates fall back to the published ones


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters that share a learning rate; the name appears in messages and checkpoints."""

    name: str
    parameters: tuple[nn.Parameter, ...]
    learning_rate: Callable[[int], float]  # iteration (1 for the first step) -> published learning rate
    paced: bool = True  # whether it follows `Pace`; learned cameras do not
    least_pace: float = 1.0  # lower bound of the factor that `Pace` begins with, where that follows from the length
    row_rates: Callable[[], Tensor] | None = None  # factors [N, 1] on the learning rate of rows; None: all are 1

    def rate(self, iteration: int, pace: Pace | None) -> float:
        """Return the learning rate at an iteration; without a pace the published one."""
        return self.learning_rate(iteration) * (pace(iteration, self.least_pace) if pace and self.paced else 1.0)


@dataclass(frozen=True)
class Constant:
    """The same learning rate at every iteration."""

    value: float

    def __call__(self, iteration: int) -> float:
        """Return the learning rate at an iteration."""
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
        if not (self.start > 0 and self.end > 0 and self.steps >= 1):
            raise ValueError(f"{self} has no log-linear decay; both rates must be > 0 and steps >= 1")

    def __call__(self, iteration: int) -> float:
        """Return the learning rate at an iteration."""
        t = min(max(iteration / self.steps, 0.0), 1.0)
        return math.exp((1 - t) * math.log(self.start) + t * math.log(self.end))


@dataclass(frozen=True)
class Pace:
    """Ratio of learning rates to the published ones: `factor`, which falls to 1 at the end of the run.

    Adam moves a parameter by about its learning rate in a step, and random steps cover distances that grow with the
    square root of their number; so the factor is the square root of published over actual length, at most `FASTEST`.
    From `SLOWING_FROM` on it falls log-linearly to 1. OmniGS wants less of it in longer runs: `LINEAR_ITERATIONS` over
    the actual length (docs/methods.md).

    >>> Pace.of("run", 30_000).factor, Pace.of("run", 7500).factor, Pace.of("run", 60).factor
    (1.0, 2.0, 8.0)
    >>> Pace.of("run_linear", 6400).factor, Pace.of("run_linear", 1500).factor, Pace.of("run_linear", 60).factor
    (1.0, 2.0, 8.0)
    >>> pace = Pace.of(4.0, iterations=1000)
    >>> [round(pace(iteration), 9) for iteration in (600, 800, 1000)]
    [4.0, 2.0, 1.0]
    """

    factor: float
    iterations: int
    is_law: bool = False  # whether the factor follows from the length

    @classmethod
    def of(cls, choice: str | float, iterations: int, schedule: int | None = None) -> Pace:
        """Return the pace of `iterations` by a law or factor; a clock has more `schedule` steps."""
        if is_law := choice in ("run", "run_linear"):
            is_linear = choice == "run_linear"
            factor = LINEAR_ITERATIONS / iterations if is_linear else math.sqrt(PUBLISHED_ITERATIONS / iterations)
            choice = min(max(factor, 1.0), FASTEST)
        return cls(1.0 if choice == "published" else float(choice), schedule or iterations, is_law)

    def __call__(self, iteration: int, least: float = 1.0) -> float:
        """Return the factor at an iteration; one that follows from the length begins with `least` or more."""
        t, factor = iteration / self.iterations, max(self.factor, least) if self.is_law else self.factor
        return factor ** min((1 - t) / (1 - SLOWING_FROM), 1.0)


def scaled(published: int, total: int) -> int:
    """Return a published iteration number, scaled to a run of `total` iterations; at least 1.

    >>> scaled(1500, 30_000), scaled(1500, 3_000), scaled(15_000, 30_000)
    (1500, 150, 15000)
    """
    return max(1, round(published * total / PUBLISHED_ITERATIONS))
