"""Views that decide whether a smaller model is as good as a larger one, and how."""

from __future__ import annotations

import math
from collections.abc import Sequence

from padgs.evaluation.metrics import BANDS
from padgs.evaluation.protocols import PROTOCOLS
from padgs.results import Scores
from padgs.scene import View
from padgs.training.health import validation_split

RULES = PROTOCOLS["sphere"]
QUALITY, PERCEPTION = "ws_psnr", RULES.lpips_name
CONFIDENCE = 0.95
PERCEPTION_RISE = 0.005  # of LPIPS, accepted
BAND, WORST = 2.0, 5.0  # a latitude band may lose so many epsilons on average, a view so many


def calibration_split(views: Sequence[View]) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Training views evenly set apart to measure on, and those that are left to train on.

    Raises:
        ValueError: there are too few for both.
    """
    apart = validation_split(views)
    left = tuple(view for number, view in enumerate(views) if number not in apart)
    return tuple(views[number] for number in apart), left


def objections(candidate: Scores, reference: Scores, epsilon: float) -> tuple[str, ...]:
    """Why a candidate is not as good as the reference up to `epsilon` dB; nothing where it is.

    Non-inferior means: the one-sided 95 % bound of the mean paired difference of WS-PSNR over the views is above
    -epsilon, the mean difference in each latitude band above -2 epsilon, no view lost 5 epsilon, and spherical LPIPS
    rose by at most 0.005 (where it could be measured).
    """
    changes = differences(candidate, reference, QUALITY)
    found = []
    bound = lower_bound(changes)
    if not bound > -epsilon:
        found.append(f"WS-PSNR may fall by {-bound:.2f} dB")
    if not min(changes) > -WORST * epsilon:
        found.append(f"a view falls by {-min(changes):.2f} dB")
    for band in BANDS:
        band_changes = differences(candidate, reference, f"{QUALITY}_{band}")
        if band_changes and not (mean := math.fsum(band_changes) / len(band_changes)) > -BAND * epsilon:
            found.append(f"{band} falls by {-mean:.2f} dB")
    rises = differences(candidate, reference, str(PERCEPTION))
    if rises and not (rise := math.fsum(rises) / len(rises)) <= PERCEPTION_RISE:
        found.append(f"LPIPS rises by {rise:.4f}")
    return tuple(found)


def differences(candidate: Scores, reference: Scores, metric: str) -> list[float]:
    """Candidate minus reference of each view that has the metric in both; 0 where both are perfect."""
    found = []
    for name, marks in reference.views.items():
        before, after = marks.get(metric), candidate.views[name].get(metric)
        if before is not None and after is not None:
            found.append(0.0 if before == after else after - before)
    return found


def lower_bound(changes: Sequence[float]) -> float:
    """One-sided 95 % bound of the mean of paired differences, by Student's t.

    >>> round(lower_bound([0.1, 0.0, -0.1]), 3), lower_bound([0.0, 0.0, 0.0])
    (-0.169, 0.0)
    """
    from scipy.stats import t

    count = len(changes)
    mean = math.fsum(changes) / count
    variance = math.fsum((change - mean) ** 2 for change in changes) / (count - 1)
    return float(mean - t.ppf(CONFIDENCE, count - 1) * math.sqrt(variance / count))
