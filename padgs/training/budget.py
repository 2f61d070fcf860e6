"""What training may take: so many iterations or so much time, and Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass

from padgs.checks import check, check_known

AUTO = "auto"  # as many Gaussians, or iterations, as needed
STOPS = ("end", AUTO)
CLOCKS = ("wall", "cpu")  # cpu: of all threads of the process, which other programs change less


@dataclass(frozen=True)
class Budget:
    """How long a method may train, evaluation and files never counted, and how large its model may become.

    In a budget of `seconds` the schedule follows the clock: a step after half of the time is a step at half of the
    schedule, so growth, decay and the last iteration come when they should, whatever a step costs.
    """

    iterations: int  # of the schedule, and of the run where there are no seconds
    max_seconds: float | None = None  # on the wall clock, after which the run ends as it is
    seconds: float | None = None
    clock: str = "wall"  # that `seconds` are counted on: a name of CLOCKS
    gaussians: int | str | None = None  # None: as many as thresholds give; auto: without the least missed
    stop: str = "end"  # of the schedule | auto: as soon as nothing is gained, see `padgs.training.stopping`

    def __post_init__(self) -> None:
        check(self, "at least 1", lambda count: count >= 1, "iterations")
        rule = "at least 1 Gaussian, auto for as many as needed, or none for no target"
        check(self, rule, lambda n: n in (None, AUTO) or isinstance(n, int) and n >= 1, "gaussians")
        check(self, "> 0 and finite, or none", lambda s: s is None or 0 < s < math.inf, "max_seconds", "seconds")
        check_known(self, clock=CLOCKS, stop=STOPS)

    def __str__(self) -> str:
        """How people say it.

        >>> str(Budget(100)), str(Budget(1, seconds=60.0)), str(Budget(1, seconds=2.5, clock="cpu"))
        ('100 iterations', '60 s', '2.5 s of CPU time')
        """
        if self.seconds is None:
            return f"{self.iterations} iterations"
        return f"{self.seconds:g} s{' of CPU time' if self.clock == 'cpu' else ''}"

    def moment(self, last: int, spent: float, step: float, skipped: int = 0) -> int:
        """The iteration of the schedule that the next step stands for; `iterations` for the last one.

        Args:
            last: that of the step before, 0 for none.
            spent: seconds of training so far.
            step: seconds that the next step will take, as far as anybody knows.
            skipped: iterations of the schedule that no time was spent on.

        >>> Budget(100).moment(6, spent=50.0, step=1.0), Budget(100, seconds=10.0).moment(6, spent=4.0, step=1.0)
        (7, 50)
        """
        if self.seconds is None:
            return last + 1
        spent += skipped / self.iterations * self.seconds
        if spent + 1.5 * step >= self.seconds:  # one more would end more than half a step too late
            return self.iterations
        return min(max(last, round(self.iterations * (spent + step) / self.seconds), 1), self.iterations - 1)
