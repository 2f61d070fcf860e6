"""What each row of a model, a Gaussian or an anchor, is worth to some views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.render.contract import ALPHA_MIN
from padgs.render.leave_one_out import leave_one_out
from padgs.scene import View
from padgs.training.model import Prunable
from padgs.training.targets import even_weight, image_of

LEAST = 0.1  # share of the rows that stays in one step, whatever they are worth


@dataclass(frozen=True)
class Worth:
    """Of N rows, over some views; an anchor counts for the sum of its Gaussians."""

    error: Tensor  # [N] float64, mean change of the views' mean square error if a row is removed alone
    change: Tensor  # [N] float64 >= 0, mean square change of the views by that
    contribution: Tensor  # [N] float64, mean alpha T
    peak: Tensor  # [N] largest alpha T of any pixel
    views: Tensor  # [N] int64, in how many views it shows: alpha T > 1/255 somewhere
    blended: int  # Gaussians that contribute to any view at all


@torch.no_grad()
def worth(model: Prunable, views: Sequence[View]) -> Worth:
    """Score all rows by the photographs of some views: every direction of a panorama alike, every pixel of others.

    Raises:
        ValueError: no views, one without a photograph, or a model that is not drawn as its Gaussians are.
    """
    if not views:
        raise ValueError("no views to score by; give at least one")
    sums = peak = seen = None
    for view in views:
        parts = model.parts(view)
        target = image_of(view, parts.slots.device)
        weight = even_weight(view, parts.slots.device)
        found = leave_one_out(parts.gaussians, view, target, weight, parts.options)
        if sums is None or peak is None or seen is None:
            rows = next(iter(model.counts().values()))
            sums = torch.zeros(3, rows * parts.each, dtype=torch.float64, device=target.device)
            peak = torch.zeros(rows * parts.each, device=target.device)
            seen = torch.zeros(rows, dtype=torch.int64, device=target.device)
        sums[:, parts.slots] += torch.stack((found.error, found.change, found.contribution)) / len(views)
        here = torch.zeros_like(peak).index_copy(0, parts.slots, found.peak.to(peak))
        peak = torch.maximum(peak, here)
        seen += here.view(len(seen), -1).amax(-1) > ALPHA_MIN
    assert sums is not None and peak is not None and seen is not None
    error, change, contribution = sums.view(3, len(seen), -1).sum(-1)
    return Worth(error, change, contribution, peak.view(len(seen), -1).amax(-1), seen, int((peak > 0).sum()))


def most_wanted(worth: Worth, count: int) -> Tensor:
    """The rows [count] whose loss would change the views most, in ascending order; of equal ones the first.

    By `change`, not by `error`: what the residual adds to that is what refining is about to change anyway, and rows
    that do harm one by one are often needed together. On `flat` (padgs_plus, 21.6k), without refining, three tenths
    fewer cost 0.09 dB by `change`, 0.29 by `error`, 0.54 by `contribution` and 0.79 by `peak`.
    """
    order = torch.argsort(worth.change, descending=True, stable=True)
    return order[:count].sort().values


def needed(worth: Worth, psnr: float) -> int:
    """How many rows stay if the least missed go, as long as what each changes alone adds up to a PSNR of so many dB.

    In mean squares, by solid angle. Together they change far more, as they stand in for each other: right afterwards
    pictures have 19 to 40 dB to those before, and the rest of a training mends that (docs/need.md). At least a tenth
    stays, for where nearly all stand in for each other the sum says nothing.
    """
    changes = worth.change.sort().values.cumsum(0)
    return max(math.ceil(LEAST * len(changes)), int((changes > 10 ** (-psnr / 10)).sum()))
