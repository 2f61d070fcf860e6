"""Budget and options of a training."""

import math
from dataclasses import dataclass

from padgs.checks import check, check_known
from padgs.geometry.lens import AXES
from padgs.training.loss import DEPTH_KINDS, NORMALISATIONS, ROW_WEIGHTS
from padgs.training.schedule import LEARNING_RATES

GIVEN, LEARNED, LEARNED_FAST = "given", "learned", "learned_fast"  # corrections of the views
MAP, FISHEYES = "map", "fisheyes_"  # cameras of all panoramas
LENSES = (GIVEN, MAP, *(FISHEYES + axis for axis in AXES))
AUTO = "auto"  # number of Gaussians or iterations as needed
CLOCKS = ("wall", "cpu")  # cpu: summed over all threads; other programs change it less


@dataclass(frozen=True)
class Budget:
    """Length of the training, without evaluation and files, and size of the model.

    With a budget of `seconds` the schedule follows the clock: after half of the time the schedule is at half of its
    steps, so densification, decay and the last step come when they should, however long an iteration takes.
    """

    iterations: int  # of the schedule, and of the run unless `seconds` are given
    max_seconds: float | None = None  # wall time after which the run ends as it is
    seconds: float | None = None
    clock: str = "wall"  # clock of `seconds`: a name of CLOCKS
    gaussians: int | str | None = None  # None: as densification gives; auto: also prune the least important
    stop: str = "end"  # of the schedule | auto: early stopping, see `padgs.training.health`

    def __post_init__(self) -> None:
        check(self, "at least 1", lambda count: count >= 1, "iterations")
        rule = "at least 1 Gaussian, auto for as many as needed, or null for no target"
        check(self, rule, lambda n: n in (None, AUTO) or isinstance(n, int) and n >= 1, "gaussians")
        check(self, "> 0 and finite, or null", lambda s: s is None or 0 < s < math.inf, "max_seconds", "seconds")
        check_known(self, clock=CLOCKS, stop=("end", AUTO))

    def __str__(self) -> str:
        """Return the length in words.

        >>> str(Budget(100)), str(Budget(1, seconds=60.0)), str(Budget(1, seconds=2.5, clock="cpu"))
        ('100 iterations', '60 s', '2.5 s of CPU time')
        """
        if self.seconds is None:
            return f"{self.iterations} iterations"
        return f"{self.seconds:g} s{' of CPU time' if self.clock == 'cpu' else ''}"

    def next_step(self, last: int, spent: float, step_seconds: float, *, skipped: int = 0, began: float = 0.0) -> int:
        """Return the schedule step of the next iteration; `iterations` for the last one.

        `last` is the step of the iteration before, 0 for none; `spent` the seconds of training so far, with building
        the initial model; `step_seconds` the expected duration of the next iteration; `skipped` the number of steps
        that took no time; `began` the seconds before the first step, after which the schedule fills the rest.

        >>> timed = Budget(100, seconds=10.0)
        >>> Budget(100).next_step(6, spent=50.0, step_seconds=1.0), timed.next_step(6, spent=4.0, step_seconds=1.0)
        (7, 50)
        """
        if self.seconds is None:
            return last + 1
        length = self.seconds - began
        spent += skipped / self.iterations * length
        if spent + 1.5 * step_seconds >= self.seconds:  # one more would end more than half a step too late
            return self.iterations
        return min(max(last, round(self.iterations * (spent - began + step_seconds) / length), 1), self.iterations - 1)


@dataclass(frozen=True)
class TrainOptions:
    """The `train` group of the configuration, without the run length (`Budget`)."""

    lambda_l1: float = 0.8  # lambda of Eq. 16
    square_weight: float = 0.0  # weight of the squared error, added to the loss in the last 40 % of a run
    # Another colour behind each training render, where the photograph is not black: transparency cannot stand for dark
    # surfaces, which would be holes in other views. Finished models have black behind them.
    random_background: bool = False
    adam_beta2: float = 0.999  # decay of Adam's second moments
    weight: str = "solid_angle"  # M of Eq. 17: solid_angle | uniform | end_rows (as released: 0 at the poles)
    normalisation: str = "mean"  # channel_sum: 3 x the mean, as the released code does
    # published: for 30 000 iterations | run: for the length of this run, see `padgs.training.schedule.Pace` |
    # run_linear: the law that run stands for with OmniGS, SC-OmniGS, ODGS and OP43DGS |
    # a factor on the published ones.
    learning_rates: str | float = "run"
    check_every: int = 50  # iterations between checks of all gradients and parameters; the loss is checked at each
    monitor: bool = True  # end a failing run, see `padgs.training.health.Monitor`
    exposures: str = GIVEN  # learned: gain and offset of each training view; test views have the mean one
    # learned: a small correction of each training view; test views keep theirs. learned_fast: at rates of SC-OmniGS,
    # and test views follow the training views by a similarity.
    poses: str = GIVEN
    # Camera of all panoramas. map: a small distortion, a free map of directions (SC-OmniGS). fisheyes_x, _y, _z: two
    # fisheye lenses apart along an axis of the camera, stitched as one; test views have one centre (Seam360GS).
    lens: str = GIVEN
    # Weight of a loss on inverse range, in scene scales, in training views that have a depth map; 0: none.
    depth_weight: float = 0.0
    # measured: in world units, also for initial points. monocular: inverse ranges up to a scale and a shift of each
    # view, which are fitted to each render.
    depth_kind: str = "measured"
    refine: bool = False  # with init: neither densify nor prune; the model's rates are those of the last fifth

    def __post_init__(self) -> None:
        check(self, "in [0, 1]", lambda share: 0 <= share <= 1, "lambda_l1")
        check(self, "in [0, 1)", lambda decay: 0 <= decay < 1, "adam_beta2")
        check_known(self, weight=ROW_WEIGHTS, normalisation=NORMALISATIONS, depth_kind=DEPTH_KINDS)
        check(self, ">= 0 and finite", lambda weight: 0 <= weight < math.inf, "depth_weight", "square_weight")
        check_known(self, poses=(GIVEN, LEARNED, LEARNED_FAST), exposures=(GIVEN, LEARNED), lens=LENSES)
        if isinstance(self.learning_rates, str):
            check_known(self, learning_rates=LEARNING_RATES)
        else:
            check(self, "> 0 and finite", lambda factor: 0 < factor < math.inf, "learning_rates")
        check(self, "at least 1", lambda every: every >= 1, "check_every")
