"""Importance of Gaussians or anchors to the training views, and the pruning step that removes the least important.

The importance score of a row is the mean square change of the rendered training views when the row alone is removed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.methods.splats.densification import DensificationOptions
from padgs.render.contract import ALPHA_MIN
from padgs.render.leave_one_out import leave_one_out
from padgs.scene import View
from padgs.training.model import Prunable
from padgs.training.targets import even_weight, image_of

MIN_KEPT_SHARE = 0.1  # of the rows stays in one pruning step, whatever the scores


@dataclass(frozen=True)
class Importance:
    """Scores of N rows over some views; an anchor's score is the sum over its Gaussians."""

    error: Tensor  # [N] float64, mean change of the views' mean square error if a row is removed alone
    change: Tensor  # [N] float64 >= 0, mean square change of the views: the importance score
    contribution: Tensor  # [N] float64, mean alpha T
    peak: Tensor  # [N] largest alpha T of any pixel
    views: Tensor  # [N] int64, number of views with alpha T > 1/255 somewhere
    blended: int  # Gaussians that contribute to any view


@torch.no_grad()
def importance_scores(model: Prunable, views: Sequence[View]) -> Importance:
    """Score all rows; pixels of panoramas count by solid angle, those of other views equally.

    Raises:
        ValueError: no views, a view without an image, or a model that is not rendered from its Gaussians alone.
    """
    if not views:
        raise ValueError("no views to score by; give at least one")
    sums = peak = seen = None
    for view in views:
        parts = model.parts(view)
        target = image_of(view, parts.slots.device)
        weight = even_weight(view, parts.slots.device)
        removals = leave_one_out(parts.gaussians, view, target, weight, parts.options)
        if sums is None or peak is None or seen is None:
            rows = next(iter(model.counts().values()))
            sums = torch.zeros(3, rows * parts.each, dtype=torch.float64, device=target.device)
            peak = torch.zeros(rows * parts.each, device=target.device)
            seen = torch.zeros(rows, dtype=torch.int64, device=target.device)
        sums[:, parts.slots] += torch.stack((removals.error, removals.change, removals.contribution)) / len(views)
        here = torch.zeros_like(peak).index_copy(0, parts.slots, removals.peak.to(peak))
        peak = torch.maximum(peak, here)
        seen += here.view(len(seen), -1).amax(-1) > ALPHA_MIN
    assert sums is not None and peak is not None and seen is not None
    error, change, contribution = sums.view(3, len(seen), -1).sum(-1)
    return Importance(error, change, contribution, peak.view(len(seen), -1).amax(-1), seen, int((peak > 0).sum()))


def most_important(scores: Importance, count: int) -> Tensor:
    """Return the rows [count] with the largest `change`, in ascending order; ties go to the first.

    `change` rather than `error`: refinement is about to change the residual anyway, and rows that do harm one by one
    are often needed together. On `flat` (padgs_plus, 21 600 Gaussians), removing 30 % without refinement costs 0.09 dB
    by `change`, 0.29 by `error`, 0.54 by `contribution` and 0.79 by `peak`.
    """
    order = torch.argsort(scores.change, descending=True, stable=True)
    return order[:count].sort().values


def count_for_psnr(scores: Importance, psnr: float) -> int:
    """Return how many rows stay if the least important are removed until their changes add up to a PSNR, dB.

    Changes of single rows underestimate the change by all of them, because rows replace each other: renders right after
    pruning have 19 to 40 dB to those before, and the rest of the training recovers that (docs/plus.md). At least
    `MIN_KEPT_SHARE` stays: where nearly all rows replace each other, the sum means nothing.
    """
    changes = scores.change.sort().values.cumsum(0)
    return max(math.ceil(MIN_KEPT_SHARE * len(changes)), int((changes > 10 ** (-psnr / 10)).sum()))


class PruningStep:
    """Schedule of the one pruning by importance, a round after densification ends.

    Attributes:
        due: its iteration.
        done: whether it has taken place.
    """

    def __init__(
        self,
        options: DensificationOptions,
        iterations: int,
        *,
        requested: int | str | None,
        prune_psnr: float | None,
    ) -> None:
        """Plan the step for a run of `iterations`.

        Args:
            options: of the run, see `DensificationOptions.for_run`.
            iterations: of the run.
            requested: `budget.gaussians`: the number that stays; auto or None: as many as `count_for_psnr` says.
            prune_psnr: dB for `count_for_psnr`; None: nothing is pruned.
        """
        self._iterations, self._requested, self._prune_psnr = iterations, requested, prune_psnr
        self.due = options.densify_until - 1 + options.densify_every
        self.done = False

    def is_ahead(self, iteration: int) -> bool:
        """Return whether the step comes after this iteration."""
        return self._prune_psnr is not None and iteration < self.due

    def is_due(self, iteration: int) -> bool:
        """Return whether it is time to prune.

        If early stopping skipped the step, prune later, but only for a requested budget; a requested number is enforced
        at the end of the run at the latest. Without a budget nothing is pruned late, as little training would follow.
        """
        if self._prune_psnr is None:
            return False
        if self._requested is None:
            return iteration == self.due
        due = min(self.due, self._iterations) if isinstance(self._requested, int) else self.due
        return iteration >= due and not self.done

    def count(self, scores: Importance) -> int:
        """Return how many of the scored rows stay."""
        if isinstance(self._requested, int):
            return min(self._requested, len(scores.change))
        assert self._prune_psnr is not None, "without a PSNR nothing is pruned"
        return count_for_psnr(scores, self._prune_psnr)
