"""A guard on what single Gaussians and anchors do to a run; off by default, as no published method has one.

A row, of one Gaussian or one anchor, can spoil all others: Adam writes a NaN gradient into its parameters, and the next
drawing carries it everywhere. Networks and cameras have no guard: what is not finite there belongs to the whole model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from padgs.scene import Scene
from padgs.training.failure import Failure
from padgs.training.schedule import ParameterGroup

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
