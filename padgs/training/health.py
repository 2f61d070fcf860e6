"""The ways in which training breaks, and how they are recognised."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from padgs.render import Rendering
from padgs.scene import Scene, View
from padgs.training.model import TrainingRender
from padgs.training.schedule import ParameterGroup
from padgs.training.targets import even_weight, image_of

OUT_OF_MEMORY_MESSAGES = ("can't allocate memory", "not enough memory", "out of memory", "bad_alloc")


class Failure(RuntimeError):
    """Training cannot go on; `status` is one of `padgs.results.STATUSES` and enters the tables as such."""

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status = status


def first_non_finite(tensors: Mapping[str, Tensor | None]) -> str | None:
    """Name and first bad entry of the first tensor that holds a NaN or an infinity; None where all are finite.

    >>> first_non_finite({"a": torch.zeros(2), "b": torch.tensor([[0.0, float("nan")]]), "c": None})
    'b[0, 1] is nan'
    """
    for name, tensor in tensors.items():
        if tensor is None or torch.isfinite(tensor).all():
            continue
        index = (~torch.isfinite(tensor)).nonzero()[0].tolist()
        return f"{name}{index if index else ''} is {tensor[tuple(index)].item()}"
    return None


def memory_reason(error: BaseException) -> str:
    """What an error says that means that memory ran out, in words for who chose the sizes, not for who allocated.

    >>> memory_reason(RuntimeError("[enforce fail at x.cpp:90] . DefaultCPUAllocator: can't allocate memory: you tried "
    ...     "to allocate 8000000000 bytes. Error code 12 (Cannot allocate memory)"))
    '8.0 GB more were asked for than there are; use smaller panoramas (data.width) or fewer Gaussians'
    """
    way_out = "use smaller panoramas (data.width) or fewer Gaussians"
    if isinstance(error, MemoryError) and str(error):
        return str(error)  # of a limit of ours, or of an array that is named
    if asked := re.search(r"allocate ([\d.]+) ?([KMGT]iB|bytes)", str(error)):
        size = f"{float(asked[1]) / 1e9:.1f} GB" if asked[2] == "bytes" else f"{asked[1]} {asked[2]}"
        return f"{size} more were asked for than there are; {way_out}"
    return way_out


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error means that memory ran out; torch says so in the text of a RuntimeError only."""
    return isinstance(error, MemoryError) or any(text in str(error) for text in OUT_OF_MEMORY_MESSAGES)


LASTING, LEAST = 0.1, 100  # a sign lasts for this share of the run, and for so many iterations
SILENT = 0.25  # share of the run, of silence
SMOOTHED = 20  # iterations that the loss is averaged over, at least; or the share below of the run
SMOOTHED_SHARE = 0.02
FIRST = 5  # iterations that are no best loss yet: single views are easy
WORSE = 1.5  # times the best average loss
FALLING = 0.9  # times the highest average since then: what comes down to that recovers, as after a reset
FEWER = 0.01  # of the parts of the model at the start
FLATTER = 0.01  # of the variance of the photograph
FAINTEST = 0.05  # mean opacity of a picture
MORE = 10  # times as many parts as at the start, or as all training views have pixels
ADVICE = "train.monitor=false lets such a run go on"
GRADIENT = "gradient of "
LARGER = 10  # times as large as all that there was at the start
MANY = 0.01  # share of the Gaussians; single ones of PaD-GS grow without any harm


class Monitor:
    """Of one run. `state` holds all that it remembers, as JSON can.

    `moment` is the iteration of the schedule that is looked at, where the schedule follows the clock; None: the same.
    """

    def __init__(self, iterations: int, parts: int, pixels: int) -> None:
        """Nothing was seen yet.

        Args:
            iterations: of the schedule.
            parts: Gaussians, anchors or other parts that the model starts with; the largest of its counts.
            pixels: of all training views.
        """
        self._iterations, self._start, self._pixels = iterations, parts, pixels
        self._smoothed = max(SMOOTHED, SMOOTHED_SHARE * iterations)
        self.moment: int | None = None
        self.state: dict[str, Any] = {
            "start": parts,  # a run that began with another model is resumed from the points of its scene
            "sum": 0.0,
            "weight": 0.0,
            "seen": 0,
            "best": None,
            "largest": None,
            "since": {},
            "highest": 0.0,
            "first": FIRST,
            "halvings": None,
        }

    def forget(self) -> None:
        """Signs begin anew, as the schedule has jumped and how long they lasted means nothing."""
        self.state["since"] = {}

    def size(self, halvings: int, iteration: int) -> None:
        """Compare no loss from this iteration on with those before, if views were halved more or less often there."""
        known = self.state.get("halvings", 0)  # checkpoints of before are of full size
        if known is not None and known != halvings:
            self.state |= {"sum": 0.0, "weight": 0.0, "best": None, "highest": 0.0, "first": iteration + FIRST}
            self.state["since"].pop("diverged", None)
        self.state["halvings"] = halvings

    def loss(self, value: float, iteration: int) -> None:
        """Take in the loss of an iteration.

        Raises:
            Failure: diverged.
        """
        state = self.state
        new = -math.expm1((state["seen"] - iteration) / self._smoothed)
        state["sum"] += (value - state["sum"]) * new
        state["weight"] += (1 - state["weight"]) * new
        state["seen"] = iteration
        average = state["sum"] / state["weight"]
        if iteration >= state.get("first", FIRST):  # checkpoints of before have none
            state["best"] = average if state["best"] is None else min(average, state["best"])
        best = state["best"]
        high = best is not None and average > WORSE * best
        highest = max(average, state.get("highest", 0.0)) if high else 0.0  # nor that
        if average < FALLING * highest:
            state["since"].pop("diverged", None)
            highest = average
        state["highest"] = highest
        ends = (iteration if self.moment is None else self.moment) >= self._iterations
        if since := self._lasting("diverged", high, iteration, least=0 if ends else LEAST):
            raise Failure(
                "diverged",
                f"the loss at iteration {iteration} is {average:.4g}, and since iteration {since} more than {WORSE} "
                f"times the best, {best:.4g} (averages over {self._smoothed:.0f} iterations); {ADVICE}",
            )

    def counts(self, counts: Mapping[str, int], iteration: int) -> None:
        """Take in how many parts the model has.

        Raises:
            Failure: exploded or collapsed.
        """
        name, most = max(counts.items(), key=lambda item: item[1])
        start = self.state.get("start", self._start)  # checkpoints of before have none
        healthy = max(start, self._pixels)
        if most > MORE * healthy:
            raise Failure(
                "exploded",
                f"{most} {name} at iteration {iteration}, more than {MORE} times the {healthy} at the start or pixels "
                f"of the training views; {ADVICE}",
            )
        if since := self._lasting("few", most < FEWER * start, iteration):
            raise Failure(
                "collapsed",
                f"{most} of {start} {name} are left at iteration {iteration}, few since {since}; {ADVICE}",
            )

    def picture(self, drawing: TrainingRender, photograph: Tensor, iteration: int) -> None:
        """Take in what was drawn of a view, beside its photograph [H, W, 3].

        Raises:
            Failure: collapsed or exploded.
        """
        image, alpha = drawing.rendering.image.detach(), 1 - drawing.rendering.transmittance.detach().mean().item()
        if since := self._lasting("faint", alpha < FAINTEST, iteration):
            raise Failure(
                "collapsed", f"the mean opacity is {alpha:.3g} at iteration {iteration}, and since {since}; {ADVICE}"
            )
        shares = (image.var() / photograph.var().clamp(min=1e-12)).item()
        if since := self._lasting("flat", shares < FLATTER, iteration):
            raise Failure(
                "collapsed",
                f"the picture has {shares:.3g} of the variance of the photograph at iteration {iteration}, and since "
                f"{since}; {ADVICE}",
            )
        largest = drawing.gaussians.scales.detach().amax(-1)
        if self.state["largest"] is None:
            extent = drawing.gaussians.means.detach().double().std(0, correction=0).norm().item()
            self.state["largest"] = max(largest.max().item(), extent)
        limit = LARGER * self.state["largest"]
        share = (largest > limit).float().mean().item()
        if since := self._lasting("large", share > MANY, iteration):
            row = int(largest.argmax())
            raise Failure(
                "exploded",
                f"scales[{row}] is {largest[row].item():.3g} world units at iteration {iteration}; since {since} more "
                f"than {MANY:.0%} of all are {LARGER} times as large as anything at the start, {limit / LARGER:.3g}; "
                f"{ADVICE}",
            )

    def gradients(self, without: Sequence[str], iteration: int) -> None:
        """Take in the names of the groups of parameters all of whose gradients are exactly 0.

        Raises:
            Failure: silent.
        """
        known = {sign.removeprefix(GRADIENT) for sign in self.state["since"] if sign.startswith(GRADIENT)}
        for name in sorted({*without, *known}):
            if since := self._lasting(GRADIENT + name, name in without, iteration, SILENT):
                raise Failure(
                    "silent", f"the {GRADIENT}{name} is exactly 0 at iteration {iteration}, and since {since}; {ADVICE}"
                )

    def probe(self, gradient: Tensor | None, iteration: int) -> None:
        """Take in what growth goes by, the gradient of the probe of a drawing.

        Raises:
            Failure: silent.
        """
        if since := self._lasting("probe", gradient is None or not gradient.any(), iteration, SILENT):
            raise Failure(
                "silent",
                f"the pull that growth goes by is exactly 0 at iteration {iteration}, and since {since}, so nothing "
                f"can grow; {ADVICE}",
            )

    def _lasting(
        self, sign: str, holds: bool, iteration: int, share: float = LASTING, least: int = LEAST
    ) -> int | None:
        """Since when a sign has lasted, if that is too long."""
        since = self.state["since"]
        if not holds:
            since.pop(sign, None)
            return None
        moment = iteration if self.moment is None else self.moment
        first, began = since.setdefault(sign, [iteration, moment])
        return first if iteration - first >= least and moment - began >= share * self._iterations else None


MOST = 1e-4  # share of the rows that may be bad in a drawing; one may always
SCALES = "log_scales"  # name of the group whose last three columns are log-scales of axes
SMALLEST = 1e-6  # scale, in units of the scene
ANISOTROPY = 1e3  # longest axis in units of the shortest


class Guard:
    """On the rows of a model in training. Nothing of a step waits for a GPU but `look`.

    A bad row, which has a gradient that is not finite, counts as one without any gradient so far in that step (most
    methods have one drawing a step); Adam goes on with what it knows of the row. Anchors have the scales that their
    networks shrink; those of their Gaussians are bounded from above alone.
    """

    def __init__(self, groups: Sequence[ParameterGroup], scene: Scene, *, gradients: bool, scales: bool) -> None:
        """Before the first step.

        Args:
            groups: of the model; only those of rows are guarded.
            scene: which bounds scales: the largest is the distance of the farthest point from the first camera; or
                the unit, or what any begins with, if that is more, as of Gaussians that stand for the sky.
            gradients: leave gradients out of rows that have one which is not finite.
            scales: keep scales within bounds.
        """
        self._gradients = gradients
        self._rows = [parameter for group in groups if group.is_of_rows for parameter in group.parameters]
        self._scales = [p for group in groups if scales and group.name == SCALES for p in group.parameters]
        device = groups[0].parameters[0].device
        self._bad = torch.zeros((), dtype=torch.int64, device=device)  # rows, each as often as it was
        # Of the bad rows of a drawing, the most since a look, less those that are allowed.
        self._excess = torch.full((), -1.0, device=device)
        self._told = 0  # of the bad rows
        self._bounds = [0.0, 0.0]
        if self._scales:
            farthest = (scene.points.double() - scene.train[0].center).norm(dim=-1).max().item()
            beginning = max(parameter[..., -3:].max().item() for parameter in self._scales)
            largest = max(math.log(max(farthest, scene.scale)), beginning)
            self._bounds = [math.log(SMALLEST * scene.scale), largest]

    @torch.no_grad()
    def clean(self, probe: Tensor) -> None:
        """After `backward`: set to 0 all gradients of bad rows, and what is not finite of the probe."""
        gradients = [row.grad for row in self._rows if row.grad is not None] if self._gradients else []
        if not gradients:
            return
        if probe.grad is not None:
            probe.grad.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0)
        bad = torch.stack([~gradient.unsqueeze(-1).flatten(1).isfinite().all(1) for gradient in gradients]).any(0)
        for gradient in gradients:
            gradient.masked_fill_(bad.view(-1, *[1] * (gradient.dim() - 1)), 0.0)
        count = bad.sum()
        self._bad += count
        self._excess = torch.maximum(self._excess, count - max(1.0, MOST * len(bad)))

    @torch.no_grad()
    def bound(self) -> None:
        """After a step: bring scales back that went beyond their bounds."""
        for parameter in self._scales:
            axes = parameter[..., -3:]
            axes.clamp_(*self._bounds)
            axes.copy_(torch.maximum(axes, axes.amax(-1, keepdim=True) - math.log(ANISOTROPY)))

    def look(self, iteration: int) -> tuple[str, ...]:
        """How many rows were bad since the last look, as an event.

        Raises:
            Failure: nan; in one drawing they were more than accidents of single rows are.
        """
        if not self._gradients:
            return ()
        excess, total = self._excess.item(), int(self._bad.item())
        new, self._told = total - self._told, total
        self._excess.fill_(-1.0)
        if excess > 0:
            raise Failure(
                "nan",
                f"{new} rows had gradients that are not finite up to iteration {iteration}, too many of them at once; "
                f"train.guard_gradients leaves out {MOST:.2%} of the rows of a drawing at most, or one, as more is no "
                "accident of single rows",
            )
        return (f"left out {new} rows whose gradients were not finite",) if new else ()

    @property
    def state(self) -> dict[str, Any]:
        """All that it remembers, as JSON can hold it."""
        return {
            "bad": int(self._bad.item()),
            "excess": self._excess.item(),
            "told": self._told,
            "bounds": [*self._bounds],
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken: bounds are those of that run's beginning."""
        self._bad.fill_(state["bad"])
        self._excess.fill_(state["excess"])
        self._told, self._bounds = state["told"], [*state["bounds"]]


APART, FEWEST = 8, 3  # one training view of so many is set apart, but so many at least; and as many must be left
FADE = 0.15  # share of the schedule, at its end, that a stopped run still goes through
GAIN = 0.02  # dB, less than which ...
PATIENCE = 0.05  # ... within this share of the schedule is none
EVERY = 0.01  # share of the schedule between two measurements
SETTLED = 0.01  # share of its parts, by which a model that is neither growing nor thinned out may still change
BEST = 1e-10  # mean square error that is as good as none: 100 dB


def validation_split(views: Sequence[View]) -> tuple[int, ...]:
    """Numbers of training views, evenly spread, that a model is measured on and not trained on.

    Raises:
        ValueError: there are too few for both.
    """
    count = max(FEWEST, len(views) // APART)
    if len(views) < count + FEWEST:
        raise ValueError(
            f"{len(views)} training views leave no validation views: {FEWEST} are measured on and as many trained on; "
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
