"""A watch on a run that goes wrong without a NaN: diverged, exploded, collapsed or silent.

It looks at numbers that are there anyway: the loss at every iteration (on a GPU where somebody has read it), all else
where gradients and parameters are checked. A sign must last before it ends a run, for healthy runs show each of them
for a while: after a reset of opacities nearly nothing is seen and the loss jumps, and colours that are not in use yet
have no gradient. A loss that is still high when the run ends need not have lasted so many iterations: nothing is to
come that it could recover in. Too many parts end a run at once: no healthy one has them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from padgs.training.failure import Failure
from padgs.training.trainee import Drawing

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

    def picture(self, drawing: Drawing, photograph: Tensor, iteration: int) -> None:
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
