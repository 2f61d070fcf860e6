"""How a method is trained, beside its own options and the length of the run."""

from __future__ import annotations

import math
from dataclasses import dataclass

from padgs.checks import check, check_known
from padgs.training.loss import NORMALISATIONS, ROW_WEIGHTS
from padgs.training.schedule import LEARNING_RATES
from padgs.training.views.corrections import CHOICES, GIVEN


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
    monitor: bool = True  # end a run that diverges, explodes, collapses or falls silent: see `padgs.training.monitor`
    guard_gradients: bool = False  # gradients of Gaussians and anchors that are not finite count as none, and are told
    guard_scales: bool = False  # keep scales within bounds; both: see `padgs.training.guard`
    exposures: str = GIVEN  # learned: a gain and offset of each training view; test views have the mean one
    poses: str = GIVEN  # learned: a small correction of each training view; test views stay where they are

    def __post_init__(self) -> None:
        check(self, "in [0, 1]", lambda share: 0 <= share <= 1, "lambda_l1")
        check_known(self, weight=ROW_WEIGHTS, normalisation=NORMALISATIONS, exposures=CHOICES, poses=CHOICES)
        if isinstance(self.learning_rates, str):
            check_known(self, learning_rates=LEARNING_RATES)
        else:
            check(self, "> 0 and finite", lambda factor: 0 < factor < math.inf, "learning_rates")
        check(self, "at least 1", lambda every: every >= 1, "check_every")
