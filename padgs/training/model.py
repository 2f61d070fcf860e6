"""What can be trained: a model with its densifier and its learning rates, as the loop sees them.

Each family has one: `padgs.methods.anchors.model` (PaD-GS), `padgs.methods.splats.model` (3DGS). EgoNeRF casts rays
instead of drawing views, so it has a trainer of its own (`padgs.methods.egonerf.model`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.render import Rendering, RenderOptions
from padgs.scene import View
from padgs.training.schedule import ParameterGroup
from padgs.training.targets import Target

MODEL = "model/"  # prefix of the model's own tensors in the state of a trainer


@dataclass(frozen=True)
class State:
    """Everything that continuing bit-identically needs: tensors, and values that JSON can hold."""

    tensors: dict[str, Tensor]
    values: dict[str, Any]

    def under(self, prefix: str) -> dict[str, Tensor]:
        """The tensors whose names begin so, without that beginning."""
        return {name.removeprefix(prefix): t for name, t in self.tensors.items() if name.startswith(prefix)}

    def of_model(self) -> State:
        """The model's own part of what `Trainer.state` returned."""
        return State(self.under(MODEL), self.values["model"])


@dataclass(frozen=True)
class Size:
    """What a trained model costs to keep."""

    counts: dict[str, int]  # anchors, gaussians (potential), ...
    parameters: int  # learnable scalars
    bytes: int  # of the model alone, as stored in the checkpoint

    @staticmethod
    def of(counts: dict[str, int], parameters: Iterable[Tensor], stored: Iterable[Tensor]) -> Size:
        """The size of a model of which these tensors are learned, and those stored."""
        return Size(counts, sum(tensor.numel() for tensor in parameters), sum(tensor.nbytes for tensor in stored))


@dataclass(frozen=True)
class TrainingRender:
    """What a model drew of one view, with all that the densification statistics need after `backward`."""

    rendering: Rendering
    mean_offsets: Tensor  # [N, 2], [N, 3] or [N, 4] zeros; .grad is the positional gradient after backward
    gaussians: Gaussians  # the N that were drawn
    slots: Tensor  # [N] int64: the row of the model's statistics that each drawn Gaussian counts for
    _: KW_ONLY
    penalty: Tensor | None = None  # a scalar to be added to the loss
    photo: Callable[[Target], Target] | None = None  # brings the training image to where it was drawn; differentiable


class Model(Protocol):
    """A model in training.

    `load_state` must make it what `state` was taken of, sizes included, and may replace the data of parameters but not
    the parameters returned by `groups`.
    """

    def groups(self) -> list[ParameterGroup]:
        """All learnable parameters, each in exactly one group, with their learning rates in this run."""
        ...

    def draw(self, view: View) -> TrainingRender:
        """Render a view, differentiably."""
        ...

    def observe(self, drawing: TrainingRender, iteration: int) -> None:
        """Collect statistics; called after `backward` and before the optimizer step."""
        ...

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Grow and prune where it is time to; called after the optimizer step. Returns events for the record."""
        ...

    def render(self, view: View) -> Rendering:
        """Render a view without gradients."""
        ...

    def counts(self) -> dict[str, int]:
        """What the model consists of now: anchors, gaussians, ..."""
        ...

    def size(self) -> Size:
        """What keeping the model costs."""
        ...

    def state(self) -> State:
        """Parameters, statistics and random state, without the optimizer; not copies."""
        ...

    def load_state(self, state: State) -> None:
        """Become the model that `state` was taken of."""
        ...

    def load_model(self, state: State) -> None:
        """Take the parameters alone, with nothing noted of their training: for another run that begins with them."""
        ...


@dataclass(frozen=True)
class Parts:
    """What a view sees of a model that can lose rows, and which Gaussian belongs to which."""

    gaussians: Gaussians  # the N that are drawn
    slots: Tensor  # [N] int64, no two alike; the same Gaussian has the same one in all views
    each: int  # Gaussians that a row can show at most: row i has slots from i `each` on
    options: RenderOptions  # how they are drawn


@runtime_checkable
class Prunable(Model, Protocol):
    """A model of Gaussians whose rows, single Gaussians or anchors, can be taken away."""

    def parts(self, view: View) -> Parts:
        """What a view sees; raises ValueError where views are drawn otherwise than a plain `render` does."""
        ...

    def prune(self, count: int, views: Sequence[View]) -> None:
        """Keep the `count` rows that are most important to the views."""
        ...

    def keep(self, rows: Tensor) -> None:
        """Keep these rows only, [N] bool, or row numbers in ascending order; of all that has rows, but no optimizer."""
        ...
