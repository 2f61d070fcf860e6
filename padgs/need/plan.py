"""Which model to make next, and what the models made so far say. Pure functions of a list of steps.

The first step leaves out what no training view shows. Each other one refines a model without the calibration views, for
always as many iterations, after it took rows from it: three tenths at a time, until even the largest loss asked for is
exceeded; then, for each loss, so many that it is half-way (in log N) between the smallest model that is good enough and
the next smaller one.

A model that was refined forgets what the run knew of the calibration views, and gains what any training on gains. So it
is compared with one that was refined as often and lost nothing, its control; these are steps, too.

Then, for one loss, harmonics: the model that was kept is refined with all of its degrees, and with one less each time
until it is no longer as good as with all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from padgs.need.calibration import QUALITY, differences, objections
from padgs.results import NEED_LOSSES, Scores

KEPT = 0.7  # of the rows, in a step down; with more gone at once their removals no longer add up
CLOSE = 1.2  # two sizes this close are told apart no further
FEWEST_ROWS = 10
SLOPE = 0.1  # dB per doubling, from which on more Gaussians are worth having
HALF_A_DOUBLING = 2**-0.5


@dataclass(frozen=True)
class Plan:
    """A model to be made: from that of step `parent`, or for the first from the run's own, with so many rows or all."""

    kind: str  # waste | control | prune | degree
    parent: int | None
    rows: int | None = None
    degree: int | None = None  # highest of the harmonics, or None for those that there are


@dataclass(frozen=True)
class Step:
    """A model that was made, and measured."""

    kind: str
    parent: int | None
    depth: int  # how often it was refined since the run
    rows: int  # Gaussians, or anchors
    blended: int  # Gaussians that contribute to any training view
    bytes: int
    frame_ms: float  # of the quickest of some frames of calibration views
    marks: Scores  # of the calibration views
    test: dict[str, float | None] = field(default_factory=dict)  # metric -> mean over the test views; decides nothing
    seconds: float = 0.0  # to make and measure it
    cpu_seconds: float = 0.0
    degree: int | None = None  # of steps of that kind


def control(steps: Sequence[Step], depth: int) -> int | None:
    """The step that was refined so often and lost nothing, if it was made."""
    return next((n for n, s in enumerate(steps) if s.kind in ("waste", "control") and s.depth == depth), None)


def models(steps: Sequence[Step]) -> list[int]:
    """The first step and all that rows were taken from, from large to small."""
    return sorted((n for n, s in enumerate(steps) if s.kind in ("waste", "prune")), key=lambda n: -steps[n].rows)


def degrees(steps: Sequence[Step], parent: int) -> list[int]:
    """The steps that harmonics were taken from a model in, from all of them to few."""
    return [number for number, step in enumerate(steps) if step.kind == "degree" and step.parent == parent]


def against(steps: Sequence[Step], number: int, epsilon: float) -> tuple[str, ...]:
    """Why a step is not as good as its control up to epsilon; nothing where it is."""
    return objections(steps[number].marks, _beside(steps, number).marks, epsilon)


def loss(steps: Sequence[Step], number: int) -> float:
    """Mean WS-PSNR, dB, that a step lost on the calibration views against its control."""
    losses = differences(_beside(steps, number).marks, steps[number].marks, QUALITY)
    return math.fsum(losses) / len(losses)


def _beside(steps: Sequence[Step], number: int) -> Step:
    """What a step is compared with: its control, or the same model with all of its harmonics."""
    step = steps[number]
    if step.kind == "degree" and step.parent is not None:
        return steps[degrees(steps, step.parent)[0]]
    other = control(steps, step.depth)
    assert other is not None, "controls are made first"
    return steps[other]


def smallest(steps: Sequence[Step], epsilon: float) -> int:
    """The smallest model as good as its control up to epsilon; of several steps at least the first."""
    return [number for number in models(steps) if not against(steps, number, epsilon)][-1]


def plan(steps: Sequence[Step], epsilons: Sequence[float] = NEED_LOSSES) -> Plan | None:
    """What to make next; None where all is known."""
    if not steps:
        return Plan("waste", None)
    wanted = _pruned(steps, epsilons)
    if wanted is None or wanted.parent is None:
        return wanted
    depth = steps[wanted.parent].depth
    if control(steps, depth + 1) is None:
        return Plan("control", control(steps, depth))
    return wanted


def plan_degree(steps: Sequence[Step], parent: int, degree: int, epsilon: float) -> Plan | None:
    """What to make next of a model that has harmonics up to a degree; None where the lowest good one is known."""
    made = degrees(steps, parent)
    lower = degree - len(made)
    if lower < 0 or made and against(steps, made[-1], epsilon):
        return None
    return None if degree == 0 else Plan("degree", parent, degree=lower)


def narrowest(steps: Sequence[Step], parent: int, epsilon: float) -> int:
    """The step of the lowest degree that is as good as all up to epsilon; `parent` itself where that takes all."""
    good = [number for number in degrees(steps, parent) if not against(steps, number, epsilon)]
    return good[-1] if len(good) > 1 else parent


def _pruned(steps: Sequence[Step], epsilons: Sequence[float]) -> Plan | None:
    last = models(steps)[-1]
    down = math.ceil(KEPT * steps[last].rows)
    if smallest(steps, max(epsilons)) == last and FEWEST_ROWS <= down < steps[last].rows:
        return Plan("prune", last, down)
    for epsilon in sorted(epsilons, reverse=True):
        enough = smallest(steps, epsilon)
        rows = steps[enough].rows
        below = max((steps[n].rows for n in models(steps) if steps[n].rows < rows), default=rows)
        middle = round(math.sqrt(rows * below))
        if rows > CLOSE * below and below < middle < rows:
            return Plan("prune", enough, middle)
    return None


def knee(steps: Sequence[Step]) -> int | None:
    """The largest model below which quality falls by more than 0.1 dB per halving; None where it never does.

    Slopes are taken over at least half a doubling: over less they are noise.
    """
    order = models(steps)
    for number in order:
        rows = steps[number].rows
        lower = next((n for n in order if steps[n].rows <= HALF_A_DOUBLING * rows), None)
        if lower is not None:
            fall = loss(steps, lower) - loss(steps, number)
            if fall / math.log2(rows / steps[lower].rows) > SLOPE:
                return number
    return None
