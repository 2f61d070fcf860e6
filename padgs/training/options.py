"""How a method is trained, beside its own options and the length of the run."""

from __future__ import annotations

import math
from dataclasses import dataclass

from padgs.checks import check, check_known
from padgs.training.corrections import CHOICES, GIVEN
from padgs.training.loss import NORMALISATIONS, ROW_WEIGHTS
from padgs.training.schedule import LEARNING_RATES

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
    stop: str = "end"  # of the schedule | auto: as soon as nothing is gained, see `padgs.training.health`

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


@dataclass(frozen=True)
class TrainOptions:
    """The `train` group of the configuration, without the run length (`Budget`)."""

    lambda_l1: float = 0.8  # lambda of Eq. 16
    weight: str = "solid_angle"  # M of Eq. 17, see `padgs.training.loss.ROW_WEIGHTS`
    normalisation: str = "mean"  # channel_sum: 3 x the mean, as the released code does
    # published: made for 30 000 iterations | run: made for the length of this run, see `padgs.training.schedule.Pace` |
    # a factor on the published ones, at the beginning.
    learning_rates: str | float = "run"
    check_every: int = 50  # iterations between checks of all gradients and parameters; the loss is checked at each
    monitor: bool = True  # end a run that diverges, explodes, collapses or falls silent: see `padgs.training.health`
    guard_gradients: bool = False  # gradients of Gaussians and anchors that are not finite count as none, and are told
    guard_scales: bool = False  # keep scales within bounds; both: see `padgs.training.health`
    exposures: str = GIVEN  # learned: a gain and offset of each training view; test views have the mean one
    poses: str = GIVEN  # learned: a small correction of each training view; test views stay where they are
    refine: bool = False  # with init: neither densify nor prune; learning rates are those of the schedule's last fifth
    hold_out: bool = False  # train without the validation views, see `padgs.training.health`

    def __post_init__(self) -> None:
        check(self, "in [0, 1]", lambda share: 0 <= share <= 1, "lambda_l1")
        check_known(self, weight=ROW_WEIGHTS, normalisation=NORMALISATIONS, exposures=CHOICES, poses=CHOICES)
        if isinstance(self.learning_rates, str):
            check_known(self, learning_rates=LEARNING_RATES)
        else:
            check(self, "> 0 and finite", lambda factor: 0 < factor < math.inf, "learning_rates")
        check(self, "at least 1", lambda every: every >= 1, "check_every")
