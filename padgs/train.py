"""The training loop: one generator of records over anything that is `Trainable`. Knows no files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.method import State
from padgs.render import Rendering
from padgs.scene import View
from padgs.schedule import ParameterGroup


@dataclass(frozen=True)
class Drawing:
    """What a model drew of one view, with all that the densification statistics need after `backward`."""

    rendering: Rendering
    probe: Tensor  # [N, 2]; its .grad is filled by backward
    gaussians: Gaussians  # the N that were drawn
    slots: Tensor  # [N] int64: the row of the model's statistics that each drawn Gaussian counts for


class Trainable(Protocol):
    """A model that can be optimised by `train`.

    `load_state` must make the model what `state` was taken of, sizes included, and may replace the data of parameters
    but not the parameters returned by `groups`.
    """

    def groups(self) -> list[ParameterGroup]:
        """All learnable parameters, each in exactly one group."""
        ...

    def draw(self, view: View) -> Drawing:
        """Render a view, differentiably."""
        ...

    def observe(self, drawing: Drawing, iteration: int) -> None:
        """Collect statistics; called after `backward` and before the optimiser step."""
        ...

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Grow and prune where it is time to; called after the optimiser step. Returns events for the record."""
        ...

    def counts(self) -> dict[str, int]:
        """What the model consists of now: anchors, gaussians, ..."""
        ...

    def state(self) -> State:
        """Parameters, statistics and random state, without the optimiser."""
        ...

    def load_state(self, state: State) -> None:
        """Become the model that `state` was taken of."""
        ...
