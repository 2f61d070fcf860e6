"""Health of a training: failures, the monitor that ends failing runs, and early stopping."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from padgs.render import Rendering
from padgs.scene import View
from padgs.training.model import Model, TrainingRender
from padgs.training.options import Budget
from padgs.training.targets import BLACK, Target, even_weight, image_of

OUT_OF_MEMORY_MESSAGES = ("can't allocate memory", "not enough memory", "out of memory", "bad_alloc")

LASTING, MIN_LASTING = 0.1, 100  # a sign must last for this share of the run, and for this many iterations
SMOOTHED, SMOOTHED_SHARE = 20, 0.02  # the loss is averaged over the larger of these: iterations, share of the run
FIRST = 5  # iterations that cannot be the best loss: single views are easy
WORSE = 1.5  # average loss relative to the best
FALLING = 0.9  # average loss relative to the highest since it rose; below it the loss recovers, as after a reset
FEWER = 0.01  # share of the initial Gaussians or anchors
FLATTER = 0.01  # share of the variance of the image
FAINTEST = 0.05  # mean opacity where the photograph counts and is not black
MORE = 10  # times the initial number of Gaussians or anchors, or the pixels of all training views
ADVICE = "to train it to its end all the same, start it again with train.monitor=false retry=failed"

VALIDATION_SHARE, MIN_VALIDATION = 8, 3  # one of so many training views is held out, and at least so many are
FADE = 0.15  # share of the schedule, at its end, that a stopped run still goes through
GAIN = 0.02  # dB; a smaller gain ...
PATIENCE = 0.05  # ... within this share of the schedule stops the run
EVERY = 0.01  # share of the schedule between two measurements
SETTLED = 0.01  # largest relative change of the number of Gaussians for which the run may stop
MIN_ERROR = 1e-10  # mean square error of 100 dB


class Failure(RuntimeError):
    """Training cannot go on; `status` is a key of `padgs.results.STATUSES`."""

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status = status


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error means that memory ran out; torch says so only in the text of a RuntimeError."""
    return isinstance(error, MemoryError) or any(text in str(error) for text in OUT_OF_MEMORY_MESSAGES)


def memory_reason(error: BaseException) -> str:
    """Return the reason of an out-of-memory error, in words for users.

    >>> memory_reason(RuntimeError("[enforce fail at x.cpp:90] . DefaultCPUAllocator: can't allocate memory: you tried "
    ...     "to allocate 8000000000 bytes. Error code 12 (Cannot allocate memory)"))
    '8.0 GB more were requested than there are; use smaller panoramas (data.width) or fewer Gaussians'
    """
    way_out = "use smaller panoramas (data.width) or fewer Gaussians"
    if isinstance(error, MemoryError) and str(error):
        return str(error)  # of a limit in padgs, or of a named array
    if found := re.search(r"allocate ([\d.]+) ?([KMGT]iB|bytes)", str(error)):
        size = f"{float(found[1]) / 1e9:.1f} GB" if found[2] == "bytes" else f"{found[1]} {found[2]}"
        return f"{size} more were requested than there are; {way_out}"
    return way_out


class Monitor:
    """Ends a run that fails without a NaN, by a Failure: diverged, exploded or collapsed.

    It reads the loss at every iteration (on a GPU when it has been read), and all else when gradients and parameters
    are checked. A sign must last before it ends a run: healthy runs show each sign for a while, as after a reset of
    opacities. Too many Gaussians end a run at once, and so does a loss at the last step that rose and has not fallen
    since. `state` is JSON.
    """

    def __init__(self, iterations: int, count: int, pixels: int, *, active: bool = True) -> None:
        """Begin a run with `count` parts of the model, and views of `pixels`; it ends none unless it is `active`."""
        self._iterations, self._pixels, self._active = iterations, pixels, active
        self._smoothed = max(SMOOTHED, SMOOTHED_SHARE * iterations)
        self._step: int | None = None  # schedule step of the iteration; None if both are the same
        self.state: dict[str, Any] = {
            **{"start": count, "sum": 0.0, "weight": 0.0, "seen": 0, "best": None},
            **{"since": {}, "highest": 0.0, "peak": 0.0, "first": FIRST, "halvings": None},
        }

    def begin(self, step: int, halvings: int, iteration: int) -> None:
        """Begin an iteration; losses are not compared with those of views that were halved more or less often."""
        state, self._step = self.state, step
        if state["halvings"] is not None and state["halvings"] != halvings:
            state |= {"sum": 0.0, "weight": 0.0, "best": None, "highest": 0.0, "peak": 0.0, "first": iteration + FIRST}
            state["since"].pop("diverged", None)
        state["halvings"] = halvings

    def loss(self, value: float, iteration: int) -> None:
        """Check the loss of an iteration."""
        state = self.state
        new = -math.expm1((state["seen"] - iteration) / self._smoothed)
        state["sum"] += (value - state["sum"]) * new
        state["weight"] += (1 - state["weight"]) * new
        state["seen"] = iteration
        average = state["sum"] / state["weight"]
        if iteration >= state["first"]:
            state["best"] = average if state["best"] is None else min(average, state["best"])
        best = state["best"]
        high = best is not None and average > WORSE * best
        highest, peak = (max(average, state[key]) if high else 0.0 for key in ("highest", "peak"))
        if average < FALLING * highest:
            state["since"].pop("diverged", None)
            highest = average
        state["highest"], state["peak"] = highest, peak
        ends = (iteration if self._step is None else self._step) >= self._iterations
        recovers = average < FALLING * peak  # as after pruning late in a short run
        if since := self._lasting("diverged", high, iteration, least=0 if ends and not recovers else MIN_LASTING):
            self._fail(
                "diverged",
                f"the loss at iteration {iteration} is {average:.4g}, and since iteration {since} more than {WORSE} "
                f"times the best, {best:.4g} (averages over {self._smoothed:.0f} iterations)",
            )

    def counts(self, counts: Mapping[str, int], iteration: int) -> None:
        """Check the size of the model."""
        name, most = max(counts.items(), key=lambda item: item[1])
        start = self.state["start"]
        healthy = max(start, self._pixels)
        if most > MORE * healthy:
            self._fail(
                "exploded",
                f"{most} {name} at iteration {iteration}, more than {MORE} times the {healthy} at the start or pixels "
                "of the training views",
            )
        if since := self._lasting("few", most < FEWER * start, iteration):
            self._fail("collapsed", f"{most} of {start} {name} are left at iteration {iteration}, few since {since}")

    def render(self, rendered: TrainingRender, target: Target, iteration: int) -> None:
        """Check a render where its target counts; a black void is to stay empty."""
        at, image, rendering = f"at iteration {iteration}, and since", target.image, rendered.rendering
        counts = (target.weight > 0).expand(image.shape[:2])
        alpha = 1 - rendering.transmittance.detach()[counts & (image.amax(-1) > BLACK)].mean().item()
        if since := self._lasting("faint", alpha < FAINTEST, iteration):
            self._fail("collapsed", f"the mean opacity is {alpha:.3g} {at} {since}")
        share = (rendering.image.detach()[counts].var() / image[counts].var().clamp(min=1e-12)).item()
        if since := self._lasting("flat", share < FLATTER, iteration):
            self._fail("collapsed", f"the render has {share:.3g} of the variance of the image {at} {since}")

    def _fail(self, status: str, reason: str) -> None:
        if self._active:
            raise Failure(status, f"{reason}; {ADVICE}")

    def _lasting(self, sign: str, holds: bool, iteration: int, least: int = MIN_LASTING) -> int | None:
        """Return the iteration since which a sign has lasted, if it has lasted too long."""
        since = self.state["since"]
        if not holds:
            since.pop(sign, None)
            return None
        step = iteration if self._step is None else self._step
        first, began = since.setdefault(sign, [iteration, step])
        return first if iteration - first >= least and step - began >= LASTING * self._iterations else None


def validation_split(views: Sequence[View]) -> tuple[int, ...]:
    """Return the indices of evenly spread training views that are measured and not trained on."""
    count = max(MIN_VALIDATION, len(views) // VALIDATION_SHARE)
    if len(views) < count + MIN_VALIDATION:
        raise ValueError(
            f"{len(views)} training views leave no validation views: {MIN_VALIDATION} are measured and as many trained "
            f"on; it takes {2 * MIN_VALIDATION}"
        )
    return tuple(int((number + 0.5) * len(views) / count) for number in range(count))


@torch.no_grad()
def quality(render: Callable[[View], Rendering], views: Sequence[View]) -> float:
    """Return the mean WS-PSNR of views, dB, at most 100; plain PSNR for perspective views; a Failure if it is NaN."""
    total = 0.0
    for view in views:
        image = render(view).image.clamp(0, 1)
        error = (image - image_of(view, image.device)).square().mean(-1)
        weight = even_weight(view, image.device).expand_as(error)
        mean = ((error * weight).sum() / weight.sum()).item()
        if not math.isfinite(mean):
            raise Failure("nan", f"the render of validation view {view.name} is not finite")
        total -= 10 * math.log10(max(MIN_ERROR, mean))
    return total / len(views)


class EarlyStopping:
    """Ends a run when validation views gain nothing; they are trained on during the final fade.

    A stopped run jumps to the last `FADE` of its schedule, in which learning rates fall, and ends like any other.
    `held_out` are the indices of the validation views, none if the budget does not stop early; `fade` is the schedule
    step from which the run fades, `state` the measurements so far, as JSON.
    """

    def __init__(self, views: Sequence[View], budget: Budget) -> None:
        """Choose the validation views among the training views."""
        iterations = budget.iterations
        self.held_out = validation_split(views) if budget.stop == "auto" else ()
        self.fade = min(round((1 - FADE) * iterations), iterations - 1)  # at least one step ends a run
        self._views = [views[index] for index in self.held_out]
        self._every = max(1, round(EVERY * iterations))
        self.state: dict[str, Any] = {"next": self._every, "averages": [], "counts": []}

    def reason(self, model: Model, step: int) -> str:
        """Measure the validation views if that is due at a schedule step; return why to stop, or an empty string."""
        if not self._views or step < self.state["next"]:
            return ""
        if not self._is_settled(quality(model.render, self._views), max(model.counts().values()), step):
            return ""
        return f"less than {GAIN} dB were gained within {PATIENCE:.0%} of the schedule"

    def _is_settled(self, psnr: float, count: int, step: int) -> bool:
        """Add a measurement (dB) of `count` parts; return whether their average gains nothing, at steady counts."""
        span = round(PATIENCE / EVERY)
        averages, counts = self.state["averages"][-span:], [*self.state["counts"][-span:], count]
        averages = [*averages, averages[-1] + (psnr - averages[-1]) / span if averages else psnr]
        self.state = {"next": step + self._every, "averages": averages, "counts": counts}
        steady = max(counts) - min(counts) <= SETTLED * count
        return len(averages) > span and steady and averages[-1] - averages[0] < GAIN
