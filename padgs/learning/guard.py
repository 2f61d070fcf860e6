"""A guard on what single Gaussians and anchors do to a run; off by default, as no published method has one.

A row, of one Gaussian or one anchor, can spoil all others: Adam writes a NaN gradient into its parameters, and the next
drawing carries it everywhere. Networks and cameras have no guard: what is not finite there belongs to the whole model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from padgs.learning.failure import Failure
from padgs.learning.schedule import ParameterGroup
from padgs.scene import Scene

MOST = 1e-4  # share of the rows that may be left out of a step; one may always
SCALES = "log_scales"  # name of the group whose entries, by threes, are log-scales of axes
SMALLEST = 1e-6  # scale, in units of the scene
ANISOTROPY = 1e3  # longest axis in units of the shortest


class Guard:
    """On the rows of a model in training. Nothing of it waits for a GPU but `look` and `left_out`."""

    def __init__(self, groups: Sequence[ParameterGroup], scene: Scene, *, gradients: bool, scales: bool) -> None:
        """Before the first step.

        Args:
            groups: of the model; only those of rows are guarded.
            scene: which bounds scales: the largest is the distance of the farthest point from the first camera; or
                the unit, or what any begins with, if that is more, as of Gaussians that stand for the sky.
            gradients: leave rows out of a step that have a gradient which is not finite.
            scales: keep scales within bounds.
        """
        self._gradients, self._told = gradients, 0
        self._rows = [parameter for group in groups if group.is_of_rows for parameter in group.parameters]
        self._scales = [p for group in groups if scales and group.name == SCALES for p in group.parameters]
        device = groups[0].parameters[0].device
        self._left_out, self._most = torch.zeros((), dtype=torch.int64, device=device), torch.zeros((), device=device)
        if self._scales:
            farthest = (scene.points.double() - scene.train[0].center).norm(dim=-1).max().item()
            beginning = max(parameter.max().item() for parameter in self._scales)
            self._smallest = math.log(SMALLEST * scene.unit)
            self._largest = max(math.log(max(farthest, scene.unit)), beginning)

    @property
    def left_out(self) -> int:
        """How many rows were left out of steps so far, each as often as it was."""
        return int(self._left_out.item())

    @left_out.setter
    def left_out(self, count: int) -> None:
        self._left_out.fill_(count)
        self._told = count

    @torch.no_grad()
    def clean(self, probe: Tensor) -> None:
        """After `backward`: set to 0 all gradients of rows that have one which is not finite, and such of the probe."""
        gradients = [row.grad for row in self._rows if row.grad is not None] if self._gradients else []
        if not gradients:
            return
        if probe.grad is not None:
            probe.grad.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0)
        flat = [gradient.view(len(gradient), -1) for gradient in gradients]
        bad = torch.stack([~gradient.isfinite().all(1) for gradient in flat]).any(0)
        for gradient in flat:
            gradient.masked_fill_(bad[:, None], 0.0)
        count = bad.sum()
        self._left_out += count
        self._most = torch.maximum(self._most, (count - 1) / len(bad))

    @torch.no_grad()
    def bound(self) -> None:
        """After a step: bring scales back that went beyond their bounds."""
        for parameter in self._scales:
            axes = parameter.unflatten(-1, (-1, 3))
            axes.clamp_(self._smallest, self._largest)
            axes.copy_(torch.maximum(axes, axes.amax(-1, keepdim=True) - math.log(ANISOTROPY)))

    def look(self, iteration: int) -> tuple[str, ...]:
        """How many rows were left out since the last look, as an event.

        Raises:
            Failure: nan; in one step they were more than accidents of single rows are.
        """
        if not self._gradients:
            return ()
        most, total = self._most.item(), self.left_out
        self._most.zero_()
        if most > MOST:
            raise Failure(
                "nan",
                f"gradients of {most:.2%} of the rows were not finite in one step up to iteration {iteration}; "
                f"train.guard_gradients leaves out {MOST:.2%} at most, as more is no accident of single rows",
            )
        new, self._told = total - self._told, total
        return (f"left out {new} rows whose gradients were not finite",) if new else ()
