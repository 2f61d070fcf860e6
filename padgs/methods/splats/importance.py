"""Importance of Gaussians or anchors to the training views, and the pruning step that removes the least important.

The importance score of a row is the mean square change of the rendered training views when the row alone is removed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.methods.splats.densification import DensificationOptions
from padgs.render.leave_one_out import leave_one_out
from padgs.scene import View
from padgs.training.model import Prunable
from padgs.training.targets import even_weight, image_of

GROWN_PER_KEPT = 2  # Gaussians before the pruning step per Gaussian after it, about
MIN_KEPT_SHARE = 0.1  # of the rows stays in one pruning step, whatever the scores
RECOVERY = 100  # iterations after the step, or too much is lost: `bedroom` 15 dB with 22, 2.2 with 55, 0.3 with 110
# Share of the run after it, as less recovers while rates fall: SPaGS on `room` 3.7 dB with 0.33, 0.9 dB with 0.4.
RECOVERY_SHARE = 0.38


@dataclass(frozen=True)
class Importance:
    """Scores of N rows over some views; an anchor's score is the sum over its Gaussians."""

    change: Tensor  # [N] float64 >= 0, mean square change of the views: the importance score
    blended: int  # Gaussians that contribute to any view


@torch.no_grad()
def importance_scores(model: Prunable, views: Sequence[View]) -> Importance:
    """Score all rows; pixels of panoramas count by solid angle, those of other views equally."""
    if not views:
        raise ValueError("no views to score by; give at least one")
    rows, change, contributes = next(iter(model.counts().values())), None, None
    total = sum(view.weight for view in views)
    for view in views:
        parts = model.parts(view)
        target, weight = image_of(view, parts.slots.device), even_weight(view, parts.slots.device)
        removals = leave_one_out(parts.gaussians, view, target, weight, parts.options)
        if change is None or contributes is None:
            change = torch.zeros(rows * parts.each, dtype=torch.float64, device=target.device)
            contributes = torch.zeros(rows * parts.each, dtype=torch.bool, device=target.device)
        change[parts.slots] += removals.change * view.weight / total
        contributes[parts.slots] |= removals.peak > 0
    assert change is not None and contributes is not None
    return Importance(change.view(rows, -1).sum(-1), int(contributes.sum()))


def most_important(scores: Importance, count: int) -> Tensor:
    """Return the rows [count] with the largest `change`, in ascending order; ties go to the first.

    The change of renders ranks better than that of their error, which refinement changes anyway (docs/plus.md).
    """
    order = torch.argsort(scores.change, descending=True, stable=True)
    return order[:count].sort().values


def count_for_psnr(scores: Importance, psnr: float) -> int:
    """Return how many rows stay if the least important are removed until their changes add up to a PSNR, dB.

    The sum underestimates the change by all of them, because rows replace each other; training recovers that
    (docs/plus.md). At least `MIN_KEPT_SHARE` stays: where nearly all rows replace each other, the sum means nothing.
    """
    changes = scores.change.sort().values.cumsum(0)
    return max(math.ceil(MIN_KEPT_SHARE * len(changes)), int((changes > 10 ** (-psnr / 10)).sum()))


def pruning_iteration(options: DensificationOptions) -> int:
    """Return the iteration of the pruning step: a round after densification ends. `options` are those of the run."""
    return options.densify_until - 1 + options.densify_every


class PruningStep:
    """Schedule of the one pruning by importance, at iteration `due` unless `done`."""

    def __init__(self, options: DensificationOptions, *, requested: int | str | None, prune_psnr: float | None) -> None:
        """Plan the step of a run with these `options`, which are from `DensificationOptions.for_run`.

        `requested` is `budget.gaussians`: the number that stays; auto or None: `count_for_psnr(prune_psnr)`. Without
        `prune_psnr` there is no step.
        """
        self._requested, self._prune_psnr = requested, prune_psnr
        self.due = pruning_iteration(options)
        self.done = False

    def is_ahead(self, iteration: int) -> bool:
        """Return whether the step comes after this iteration."""
        return self._prune_psnr is not None and iteration < self.due

    def is_due(self, iteration: int) -> bool:
        """Return whether it is time to prune.

        If early stopping skipped the step, prune later, but only for a requested budget. Without a budget nothing is
        pruned late, as little training would follow.
        """
        if self._prune_psnr is None:
            return False
        if self._requested is None:
            return iteration == self.due
        return iteration >= self.due and not self.done

    def count(self, scores: Importance) -> int:
        """Return how many of the scored rows stay."""
        if isinstance(self._requested, int):
            return min(self._requested, len(scores.change))
        assert self._prune_psnr is not None, "without a PSNR nothing is pruned"
        return count_for_psnr(scores, self._prune_psnr)
