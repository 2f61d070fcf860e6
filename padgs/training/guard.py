"""A guard against single Gaussians and anchors that spoil a run; off by default, as no published method has one.

One row of the parameters (a Gaussian or an anchor) can spoil all others: Adam writes a NaN gradient into its
parameters, and the next render carries it everywhere. Networks and cameras have no guard: a NaN there concerns the
whole model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from padgs.scene import Scene
from padgs.training.health import Failure
from padgs.training.schedule import ParameterGroup

MAX_BAD = 1e-4  # share of rows that may be bad in a render; one always may
SCALES = "log_scales"  # name of the parameter group whose last three columns are log-scales of axes
MIN_SCALE = 1e-6  # scene scales
MAX_ANISOTROPY = 1e3  # longest axis over the shortest


class Guard:
    """Guards the rows of a model in training; only `report` waits for a GPU.

    Gradients of a row with a non-finite gradient are set to 0; Adam goes on with what it knows of the row. For anchors,
    scales are those that their networks shrink, so the scales of their Gaussians are bounded from above only.
    """

    def __init__(self, groups: Sequence[ParameterGroup], scene: Scene, *, gradients: bool, scales: bool) -> None:
        """Prepare.

        Args:
            groups: parameters of the model; only rows are guarded.
            scene: bounds the scales: the largest is the distance of the farthest point from the first camera, the scene
                scale, or the largest initial scale (such as of Gaussians for the sky), whichever is more.
            gradients: clean gradients of bad rows.
            scales: keep scales within bounds.
        """
        self._gradients = gradients
        self._rows = [parameter for group in groups if group.is_of_rows for parameter in group.parameters]
        self._scales = [p for group in groups if scales and group.name == SCALES for p in group.parameters]
        device = groups[0].parameters[0].device
        self._bad = torch.zeros((), dtype=torch.int64, device=device)  # rows, summed over renders
        # Largest number of bad rows in a render since the last report, minus the number that is allowed.
        self._excess = torch.full((), -1.0, device=device)
        self._reported = 0
        self._bounds = [0.0, 0.0]
        if self._scales:
            farthest = (scene.points.double() - scene.train[0].center).norm(dim=-1).max().item()
            initial = max(parameter[..., -3:].max().item() for parameter in self._scales)
            largest = max(math.log(max(farthest, scene.scale)), initial)
            self._bounds = [math.log(MIN_SCALE * scene.scale), largest]

    @torch.no_grad()
    def clean(self, mean_offsets: Tensor) -> None:
        """Set all gradients of bad rows to 0 after `backward`, and non-finite entries of the positional gradient."""
        gradients = [row.grad for row in self._rows if row.grad is not None] if self._gradients else []
        if not gradients:
            return
        if mean_offsets.grad is not None:
            mean_offsets.grad.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0)
        bad = torch.stack([~gradient.unsqueeze(-1).flatten(1).isfinite().all(1) for gradient in gradients]).any(0)
        for gradient in gradients:
            gradient.masked_fill_(bad.view(-1, *[1] * (gradient.dim() - 1)), 0.0)
        count = bad.sum()
        self._bad += count
        self._excess = torch.maximum(self._excess, count - max(1.0, MAX_BAD * len(bad)))

    @torch.no_grad()
    def bound(self) -> None:
        """Clamp scales to their bounds after a step."""
        for parameter in self._scales:
            axes = parameter[..., -3:]
            axes.clamp_(*self._bounds)
            axes.copy_(torch.maximum(axes, axes.amax(-1, keepdim=True) - math.log(MAX_ANISOTROPY)))

    def report(self, iteration: int) -> tuple[str, ...]:
        """Return the number of bad rows since the last report, as an event.

        Raises:
            Failure: nan; one render had too many bad rows.
        """
        if not self._gradients:
            return ()
        excess, total = self._excess.item(), int(self._bad.item())
        new, self._reported = total - self._reported, total
        self._excess.fill_(-1.0)
        if excess > 0:
            raise Failure(
                "nan",
                f"{new} rows had gradients that are not finite up to iteration {iteration}, too many at once; "
                f"train.guard_gradients cleans at most {MAX_BAD:.2%} of the rows of a render, or one",
            )
        return (f"cleaned {new} rows whose gradients were not finite",) if new else ()

    @property
    def state(self) -> dict[str, Any]:
        """All that it remembers, as JSON can hold it."""
        counters = {"bad": int(self._bad.item()), "excess": self._excess.item(), "reported": self._reported}
        return {**counters, "bounds": [*self._bounds]}

    def load(self, state: Mapping[str, Any]) -> None:
        """Resume where `state` was taken, with the bounds of that run."""
        self._bad.fill_(state["bad"])
        self._excess.fill_(state["excess"])
        self._reported, self._bounds = state["reported"], [*state["bounds"]]
