"""Candidates of the search for the smallest model: which counts are tried, and which one is as good as the control.

The control keeps all Gaussians, and is refined likewise.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from padgs.evaluation.evaluate import MOST_DECIBELS
from padgs.evaluation.metrics import BANDS, band_rows, sphere_weight
from padgs.evaluation.protocols import PROTOCOLS
from padgs.results import Scores
from padgs.scene import Scene, View

QUALITY, PERCEPTION = "ws_psnr", str(PROTOCOLS["sphere"].lpips_name)
STEP = 0.7  # share of the rows that each candidate keeps of the last one until the largest loss is exceeded
CLOSE = 1.2  # the bisection ends at this ratio of two counts
MIN_ROWS = 10
MIN_VIEWS = 3  # test views; the bound of two is 13 times as far from their mean as their spread
CONFIDENCE, MAX_LPIPS_RISE = 0.95, 0.005
BAND, WORST = 2.0, 5.0  # a latitude band may lose so many epsilons on average, a view so many
MIN_SHARE = 0.02  # of the sphere; smaller latitude bands, or what masks leave of them, decide nothing


@dataclass(frozen=True)
class Candidate:
    """A pruned and refined model, measured."""

    run: str
    rows: int  # Gaussians, or anchors
    blended: int  # Gaussians that contribute to any training view
    bytes: int
    frame_ms: float  # the shortest of some frames
    scores: Scores  # of the test views
    seconds: float  # of pruning, refinement and measuring
    cpu_seconds: float


Shares = Mapping[str, Mapping[str, float]]  # view -> latitude band -> share of the sphere that its mask leaves


def objections(candidate: Scores, control: Scores, epsilon: float, shares: Shares) -> tuple[str, ...]:
    """Return why a candidate is inferior to the control by more than `epsilon` dB; empty if it is not.

    It is not inferior if the one-sided 95 % bound of the mean paired difference of WS-PSNR over the views is above
    -epsilon, the mean difference in each latitude band above -2 epsilon (weighted by `shares`; bands below `MIN_SHARE`
    are left out), that of each view above -5 epsilon, and spherical LPIPS rises by at most 0.005 (if it is measured).
    """
    changes, found = differences(candidate, control, QUALITY), []
    if not (bound := lower_bound([*changes.values()])) > -epsilon:
        found.append(f"WS-PSNR may fall by {-bound:.2f} dB")
    if not (worst := min(changes.values())) > -WORST * epsilon:
        found.append(f"a view falls by {-worst:.2f} dB")
    for band in BANDS:
        of_band = differences(candidate, control, f"{QUALITY}_{band}")
        weights = [shares[name][band] for name in of_band]
        if sum(weights) <= MIN_SHARE * len(shares):
            continue
        if not (mean := float(np.average([*of_band.values()], weights=weights))) > -BAND * epsilon:
            found.append(f"{band} falls by {-mean:.2f} dB")
    rises = differences(candidate, control, PERCEPTION)
    if rises and not (rise := float(np.mean([*rises.values()]))) <= MAX_LPIPS_RISE:
        found.append(f"LPIPS rises by {rise:.4f}")
    return tuple(found)


def deciding_views(scene: Scene) -> tuple[View, ...]:
    """Return the test views; a ValueError if they are too few for the search for the smallest model."""
    if len(scene.test) < MIN_VIEWS:
        raise ValueError(
            f"{len(scene.test)} test views are too few for the search for the smallest model, which compares at least "
            f"{MIN_VIEWS} not trained on; hold out more, every fourth by data.split=every data.test_every=4"
        )
    return scene.test


def band_shares(view: View) -> dict[str, float]:
    """Return the share of the sphere that a view shows in each latitude band, by solid angle and mask."""
    whole = sphere_weight(torch.empty(view.height, view.width))
    mask = view.mask()
    weight = (whole if mask is None else whole * mask).sum(1)
    return {band: (weight[band_rows(view.height, band)].sum() / whole.sum()).item() for band in BANDS}


def differences(candidate: Scores, control: Scores, metric: str) -> dict[str, float]:
    """Return candidate minus control for each view that both have the metric of; exact ones have `MOST_DECIBELS`."""
    found = {}
    for name, view in control.views.items():
        new, old = candidate.views[name].get(metric), view.get(metric)
        if new is not None and old is not None:
            found[name] = min(new, MOST_DECIBELS) - min(old, MOST_DECIBELS)
    return found


def lower_bound(changes: Sequence[float]) -> float:
    """Return the one-sided 95 % confidence bound of the mean of paired differences, by Student's t.

    >>> round(lower_bound([0.1, 0.0, -0.1]), 3), lower_bound([0.0, 0.0, 0.0])
    (-0.169, 0.0)
    """
    from scipy.stats import t

    spread = np.std(changes, ddof=1) / math.sqrt(len(changes))
    return float(np.mean(changes) - t.ppf(CONFIDENCE, len(changes) - 1) * spread)


def loss(candidates: Sequence[Candidate], candidate: Candidate) -> float:
    """Return the mean WS-PSNR in dB that a candidate loses against the control."""
    return float(np.mean([*differences(candidates[0].scores, candidate.scores, QUALITY).values()]))


def smallest(candidates: Sequence[Candidate], epsilon: float, shares: Shares) -> Candidate:
    """Return the smallest candidate that is not inferior; the first one is the control."""
    good = (c for c in candidates if not objections(c.scores, candidates[0].scores, epsilon, shares))
    return min(good, key=lambda candidate: candidate.rows)


def smallest_possible(candidates: Sequence[Candidate], epsilon: float) -> Candidate:
    """Return the smallest candidate that is not known to lose more than `epsilon` dB, with 95 % confidence.

    From it to `smallest` is the interval of the minimal count.
    """
    losses = ((c, differences(candidates[0].scores, c.scores, QUALITY)) for c in candidates)
    return min((c for c, own in losses if lower_bound([*own.values()]) <= epsilon), key=lambda one: one.rows)


def next_count(candidates: Sequence[Candidate], losses: Sequence[float], shares: Shares) -> int | None:
    """Return the count of the next candidate; None if the smallest model of each loss is known.

    They fall until the largest loss is exceeded; then log N is halved between smallest model and next candidate.
    """
    counts = [candidate.rows for candidate in candidates]
    down = math.ceil(STEP * min(counts))
    if smallest(candidates, max(losses), shares).rows == min(counts) and MIN_ROWS <= down < min(counts):
        return down
    for epsilon in sorted(losses, reverse=True):
        rows = smallest(candidates, epsilon, shares).rows
        below = max((count for count in counts if count < rows), default=rows)
        middle = round(math.sqrt(rows * below))
        if rows > CLOSE * below and below < middle < rows:
            return middle
    return None
