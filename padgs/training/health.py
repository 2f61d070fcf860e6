"""Health of a training: failures, the monitor that ends failing runs, a guard against bad rows, and early stopping."""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from padgs.render import Rendering
from padgs.scene import Scene, View
from padgs.training.model import Model, TrainingRender
from padgs.training.options import Budget
from padgs.training.schedule import ParameterGroup
from padgs.training.targets import even_weight, image_of

OUT_OF_MEMORY_MESSAGES = ("can't allocate memory", "not enough memory", "out of memory", "bad_alloc")

LASTING, MIN_LASTING = 0.1, 100  # a sign must last for this share of the run, and for this many iterations
SILENT = 0.25  # share of the run for which gradients must be 0
SMOOTHED, SMOOTHED_SHARE = 20, 0.02  # the loss is averaged over the larger of these: iterations, share of the run
FIRST = 5  # iterations that cannot be the best loss: single views are easy
WORSE = 1.5  # average loss relative to the best
FALLING = 0.9  # average loss relative to the highest since it rose; below it the loss recovers, as after a reset
FEWER = 0.01  # share of the initial Gaussians or anchors
FLATTER = 0.01  # share of the variance of the image
FAINTEST = 0.05  # mean opacity of a render
MORE = 10  # times the initial number of Gaussians or anchors, or the pixels of all training views
LARGER = 10  # times the largest initial scale or the extent of the initial Gaussians
LARGE_SHARE = 0.01  # of the Gaussians; single large ones of PaD-GS do no harm
ADVICE = "train.monitor=false lets such a run continue"
GRADIENT = "gradient of "

MAX_BAD = 1e-4  # share of rows that may be bad in a render; one always may
SCALES = "log_scales"  # name of the parameter group whose last three columns are log-scales of axes
MIN_SCALE = 1e-6  # scene scales
MAX_ANISOTROPY = 1e3  # longest axis over the shortest

VALIDATION_SHARE, MIN_VALIDATION = 8, 3  # one of so many training views is held out, and at least so many are
MIN_POOLED = 8  # validation views of a search for the smallest model
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


@contextmanager
def out_of_memory_as_failure(iteration: int) -> Iterator[None]:
    """Raise a Failure (oom) instead of errors that mean that memory ran out."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, Failure) or not is_out_of_memory(error):
            raise
        raise Failure("oom", f"out of memory at iteration {iteration}: {memory_reason(error)}") from error


class _Remembering:
    """Part of a trainer that remembers `_state`, values that JSON can hold."""

    _state: dict[str, Any]

    @property
    def state(self) -> dict[str, Any]:
        """A copy of all that it remembers."""
        return copy.deepcopy(self._state)

    def load(self, state: Mapping[str, Any]) -> None:
        """Resume where `state` was taken."""
        self._state = copy.deepcopy(dict(state))


class Monitor(_Remembering):
    """Ends a run that fails without a NaN, by a Failure: diverged, exploded, collapsed or silent.

    It reads the loss at every iteration (on a GPU when it has been read), and all else when gradients and parameters
    are checked. A sign must last before it ends a run: healthy runs show each sign for a while, as after a reset of
    opacities. Too many Gaussians end a run at once, and so does a high loss at the last step.
    """

    def __init__(self, iterations: int, count: int, pixels: int, *, active: bool = True) -> None:
        """Begin a run with `count` Gaussians, anchors or other parts, and training views of `pixels`.

        No run is ended unless the monitor is `active`.
        """
        self._iterations, self._pixels, self._active = iterations, pixels, active
        self._smoothed = max(SMOOTHED, SMOOTHED_SHARE * iterations)
        self._step: int | None = None  # schedule step of the iteration; None if both are the same
        self._state = {
            **{"start": count, "sum": 0.0, "weight": 0.0, "seen": 0, "best": None, "largest": None},
            **{"since": {}, "highest": 0.0, "first": FIRST, "halvings": None},
        }

    def forget(self) -> None:
        """Restart all signs after the schedule has jumped, because their durations are meaningless then."""
        self._state["since"] = {}

    def begin(self, step: int, halvings: int, iteration: int) -> None:
        """Begin an iteration; losses are not compared with those of views that were halved more or less often."""
        state, self._step = self._state, step
        if state["halvings"] is not None and state["halvings"] != halvings:
            state |= {"sum": 0.0, "weight": 0.0, "best": None, "highest": 0.0, "first": iteration + FIRST}
            state["since"].pop("diverged", None)
        state["halvings"] = halvings

    def loss(self, value: float, iteration: int) -> None:
        """Check the loss of an iteration."""
        state = self._state
        new = -math.expm1((state["seen"] - iteration) / self._smoothed)
        state["sum"] += (value - state["sum"]) * new
        state["weight"] += (1 - state["weight"]) * new
        state["seen"] = iteration
        average = state["sum"] / state["weight"]
        if iteration >= state["first"]:
            state["best"] = average if state["best"] is None else min(average, state["best"])
        best = state["best"]
        high = best is not None and average > WORSE * best
        highest = max(average, state["highest"]) if high else 0.0
        if average < FALLING * highest:
            state["since"].pop("diverged", None)
            highest = average
        state["highest"] = highest
        ends = (iteration if self._step is None else self._step) >= self._iterations
        if since := self._lasting("diverged", high, iteration, least=0 if ends else MIN_LASTING):
            self._fail(
                "diverged",
                f"the loss at iteration {iteration} is {average:.4g}, and since iteration {since} more than {WORSE} "
                f"times the best, {best:.4g} (averages over {self._smoothed:.0f} iterations)",
            )

    def counts(self, counts: Mapping[str, int], iteration: int) -> None:
        """Check the size of the model."""
        name, most = max(counts.items(), key=lambda item: item[1])
        start = self._state["start"]
        healthy = max(start, self._pixels)
        if most > MORE * healthy:
            self._fail(
                "exploded",
                f"{most} {name} at iteration {iteration}, more than {MORE} times the {healthy} at the start or pixels "
                "of the training views",
            )
        if since := self._lasting("few", most < FEWER * start, iteration):
            self._fail("collapsed", f"{most} of {start} {name} are left at iteration {iteration}, few since {since}")

    def render(self, rendered: TrainingRender, image: Tensor, iteration: int) -> None:
        """Check a render against its image [H, W, 3]."""
        at = f"at iteration {iteration}, and since"
        alpha = 1 - rendered.rendering.transmittance.detach().mean().item()
        if since := self._lasting("faint", alpha < FAINTEST, iteration):
            self._fail("collapsed", f"the mean opacity is {alpha:.3g} {at} {since}")
        share = (rendered.rendering.image.detach().var() / image.var().clamp(min=1e-12)).item()
        if since := self._lasting("flat", share < FLATTER, iteration):
            self._fail("collapsed", f"the render has {share:.3g} of the variance of the image {at} {since}")
        largest = rendered.gaussians.scales.detach().amax(-1)
        if self._state["largest"] is None:
            extent = rendered.gaussians.means.detach().double().std(0, correction=0).norm().item()
            self._state["largest"] = max(largest.max().item(), extent)
        limit = LARGER * self._state["largest"]
        share = (largest > limit).float().mean().item()
        if since := self._lasting("large", share > LARGE_SHARE, iteration):
            row = int(largest.argmax())
            self._fail(
                "exploded",
                f"scales[{row}] is {largest[row].item():.3g} world units at iteration {iteration}; since {since} more "
                f"than {LARGE_SHARE:.0%} of all are {LARGER} times as large as anything at the start, "
                f"{limit / LARGER:.3g}",
            )

    def gradients(self, silent: Sequence[str] | None, iteration: int) -> None:
        """Check the parameter groups whose gradients are all exactly 0, by name; None if they are not known."""
        if silent is None:
            return
        known = {sign.removeprefix(GRADIENT) for sign in self._state["since"] if sign.startswith(GRADIENT)}
        for name in sorted({*silent, *known}):
            if since := self._lasting(GRADIENT + name, name in silent, iteration, SILENT):
                self._fail("silent", f"the {GRADIENT}{name} is exactly 0 at iteration {iteration}, and since {since}")

    def positional_gradient(self, gradient: Tensor | None, iteration: int) -> None:
        """Check the positional gradient that densification uses."""
        if since := self._lasting("probe", gradient is None or not gradient.any(), iteration, SILENT):
            zero = f"the positional gradient is exactly 0 at iteration {iteration}, and since {since}"
            self._fail("silent", f"{zero}, so nothing can grow")

    def _fail(self, status: str, reason: str) -> None:
        if self._active:
            raise Failure(status, f"{reason}; {ADVICE}")

    def _lasting(
        self, sign: str, holds: bool, iteration: int, share: float = LASTING, least: int = MIN_LASTING
    ) -> int | None:
        """Return the iteration since which a sign has lasted, if it has lasted too long."""
        since = self._state["since"]
        if not holds:
            since.pop(sign, None)
            return None
        step = iteration if self._step is None else self._step
        first, began = since.setdefault(sign, [iteration, step])
        return first if iteration - first >= least and step - began >= share * self._iterations else None


class Guard:
    """Guards a model against single rows (Gaussians, anchors) that spoil a run; off by default, as none is published.

    Adam writes a NaN gradient of one row into its parameters, and the next render carries it everywhere. All gradients
    of such a row are set to 0; Adam goes on with what it knows of the row. Networks and cameras have no guard: a NaN
    there concerns the whole model. For anchors, scales are those that their networks shrink, so the scales of their
    Gaussians are bounded from above only. Only `report` waits for a GPU.
    """

    def __init__(self, groups: Sequence[ParameterGroup], scene: Scene, *, gradients: bool, scales: bool) -> None:
        """Prepare to clean `gradients` of bad rows, or to keep `scales` within bounds.

        The largest scale is the distance of the farthest point from the first camera, the scene scale, or the largest
        initial scale (such as of Gaussians for the sky), whichever is more.
        """
        self._gradients = gradients
        self._rows = [parameter for group in groups if group.is_of_rows for parameter in group.parameters]
        log_units = {group.parameters[0]: math.log(group.unit) for group in groups if group.name == SCALES}
        self._scales = log_units if scales else {}  # log-scales, and the logarithm of the world units that they are in
        device = groups[0].parameters[0].device
        # Since the last report: the sum of bad rows over renders, and the most in one render minus those allowed.
        self._bad = torch.zeros((), dtype=torch.int64, device=device)
        self._excess = torch.full((), -1.0, device=device)
        self._bounds = [0.0, 0.0]
        if self._scales:
            farthest = (scene.points.double() - scene.train[0].center).norm(dim=-1).max().item()
            initial = max(scales[..., -3:].max().item() + unit for scales, unit in log_units.items())
            largest = max(math.log(max(farthest, scene.scale)), initial)
            self._bounds = [math.log(MIN_SCALE * scene.scale), largest]

    @torch.no_grad()
    def clean(self, mean_offsets: Tensor) -> None:
        """Set all gradients of bad rows to 0 after `backward`, and non-finite entries of the positional gradient."""
        gradients = [row.grad for row in self._rows if row.grad is not None] if self._gradients else []
        if not gradients:
            return
        if mean_offsets.grad is not None:
            mean_offsets.grad.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0)
        bad = torch.stack([~gradient.unsqueeze(-1).flatten(1).isfinite().all(1) for gradient in gradients]).any(0)
        for gradient in gradients:
            gradient.masked_fill_(bad.view(-1, *[1] * (gradient.dim() - 1)), 0.0)
        count = bad.sum()
        self._bad += count
        self._excess = torch.maximum(self._excess, count - max(1.0, MAX_BAD * len(bad)))

    @torch.no_grad()
    def bound(self) -> None:
        """Clamp scales to their bounds after a step."""
        for parameter, log_unit in self._scales.items():
            axes = parameter[..., -3:]
            axes.clamp_(*(bound - log_unit for bound in self._bounds))
            axes.copy_(torch.maximum(axes, axes.amax(-1, keepdim=True) - math.log(MAX_ANISOTROPY)))

    def report(self, iteration: int) -> tuple[str, ...]:
        """Return the number of bad rows since the last report, as an event.

        Raises:
            Failure: nan; one render had too many bad rows.
        """
        if not self._gradients:
            return ()
        excess, bad = self._excess.item(), int(self._bad.item())
        self._excess.fill_(-1.0)
        self._bad.zero_()
        if excess > 0:
            raise Failure(
                "nan",
                f"{bad} rows had gradients that are not finite up to iteration {iteration}, too many at once; "
                f"train.guard_gradients cleans at most {MAX_BAD:.2%} of the rows of a render, or one",
            )
        return (f"cleaned {bad} rows whose gradients were not finite",) if bad else ()

    @property
    def state(self) -> dict[str, Any]:
        """All that it remembers, as JSON can hold it."""
        return {"bad": int(self._bad.item()), "excess": self._excess.item(), "bounds": [*self._bounds]}

    def load(self, state: Mapping[str, Any]) -> None:
        """Resume where `state` was taken, with the bounds of that run."""
        self._bad.fill_(state["bad"])
        self._excess.fill_(state["excess"])
        self._bounds = [*state["bounds"]]


def validation_split(views: Sequence[View]) -> tuple[int, ...]:
    """Return the indices of evenly spread training views that are measured and not trained on."""
    count = max(MIN_VALIDATION, len(views) // VALIDATION_SHARE)
    if len(views) < count + MIN_VALIDATION:
        raise ValueError(
            f"{len(views)} training views leave no validation views: {MIN_VALIDATION} are measured and as many trained "
            f"on; it takes {2 * MIN_VALIDATION}"
        )
    return tuple(int((number + 0.5) * len(views) / count) for number in range(count))


def validation_folds(views: Sequence[View]) -> list[tuple[int, ...]]:
    """Return the validation views (indices) of the search for the smallest model, a quarter of the training views.

    Where that is fewer than `MIN_POOLED`, there are further folds, each measured on models that train without it.
    """
    if len(views) < MIN_POOLED:
        raise ValueError(
            f"{len(views)} training views are too few for the search for the smallest model; it measures at least "
            f"{MIN_POOLED} that its models are not trained on"
        )
    folds: list[tuple[int, ...]] = []
    for first in (2, 0, 3, 1):
        if sum(map(len, folds)) < MIN_POOLED:
            folds.append(tuple(range(first, len(views), 4)))
    return folds


@torch.no_grad()
def quality(render: Callable[[View], Rendering], views: Sequence[View]) -> float:
    """Return the mean WS-PSNR of views, dB, at most 100; plain PSNR for perspective views."""
    total = 0.0
    for view in views:
        image = render(view).image.clamp(0, 1)
        error = (image - image_of(view, image.device)).square().mean(-1)
        weight = even_weight(view, image.device).expand_as(error)
        total -= 10 * math.log10(max(MIN_ERROR, ((error * weight).sum() / weight.sum()).item()))
    return total / len(views)


class EarlyStopping(_Remembering):
    """Ends a run when validation views gain nothing; they are trained on during the final fade.

    A stopped run jumps to the last `FADE` of its schedule, in which learning rates fall, and ends like any other.

    Attributes:
        held_out: indices of the validation views; empty if the budget does not stop early.
        fade: schedule step from which the run fades.
    """

    def __init__(self, views: Sequence[View], budget: Budget) -> None:
        """Choose the validation views among the training views."""
        iterations = budget.iterations
        self.held_out = validation_split(views) if budget.stop == "auto" else ()
        self.fade = min(round((1 - FADE) * iterations), iterations - 1)  # at least one step ends a run
        self._views = [views[index] for index in self.held_out]
        self._every = max(1, round(EVERY * iterations))
        self._state = {"next": self._every, "averages": [], "counts": []}

    def reason(self, model: Model, step: int) -> str:
        """Measure the validation views if that is due at a schedule step; return why to stop, or an empty string."""
        if not self._views or step < self._state["next"]:
            return ""
        if not self._is_settled(quality(model.render, self._views), max(model.counts().values()), step):
            return ""
        return f"less than {GAIN} dB were gained within {PATIENCE:.0%} of the schedule"

    def _is_settled(self, psnr: float, count: int, step: int) -> bool:
        """Add a measurement (dB) of a model with `count` parts; return whether the moving average has stopped gaining.

        False while the number of parts changes: quality falls after growth and pruning before it rises.
        """
        span = round(PATIENCE / EVERY)
        averages, counts = self._state["averages"][-span:], [*self._state["counts"][-span:], count]
        averages = [*averages, averages[-1] + (psnr - averages[-1]) / span if averages else psnr]
        self._state = {"next": step + self._every, "averages": averages, "counts": counts}
        steady = max(counts) - min(counts) <= SETTLED * count
        return len(averages) > span and steady and averages[-1] - averages[0] < GAIN
