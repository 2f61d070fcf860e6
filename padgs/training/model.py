"""The model protocol: what the training loop needs of a trainable model, and the data that pass between them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.render import Rendering, RenderOptions
from padgs.scene import View
from padgs.training.schedule import Pace, ParameterGroup

REPLAYED = 0.2  # share of a schedule, at its end, whose learning rates a refinement goes through
MODEL = "model/"  # prefix of the model's own tensors in the state of a trainer


@dataclass(frozen=True)
class State:
    """All that resuming bit-identically needs: tensors, and values that JSON can hold."""

    tensors: dict[str, Tensor]
    values: dict[str, Any]

    def under(self, prefix: str) -> dict[str, Tensor]:
        """Return the tensors whose names begin with a prefix, without that prefix."""
        return {name.removeprefix(prefix): t for name, t in self.tensors.items() if name.startswith(prefix)}

    def of_model(self) -> State:
        """Return the model's part of a `Trainer.state`."""
        return State(self.under(MODEL), self.values["model"])


@dataclass(frozen=True)
class Size:
    """Size of a trained model."""

    counts: dict[str, int]  # anchors, gaussians (potential), ...
    parameters: int  # learnable scalars
    bytes: int  # of the model alone, as stored in the checkpoint

    @staticmethod
    def of(counts: dict[str, int], parameters: Iterable[Tensor], stored: Iterable[Tensor]) -> Size:
        """Return the size of a model with these learned and these stored tensors."""
        return Size(counts, sum(tensor.numel() for tensor in parameters), sum(tensor.nbytes for tensor in stored))


@dataclass(frozen=True)
class TrainingRender:
    """A differentiable render of one view, with all that densification statistics need after `backward`."""

    rendering: Rendering
    mean_offsets: Tensor  # [N, 2], [N, 3] or [N, 4] zeros; .grad is the positional gradient after backward
    gaussians: Gaussians  # the N that were drawn
    slots: Tensor  # [N] int64: row of the model's statistics for each drawn Gaussian
    _: KW_ONLY
    penalty: Tensor | None = None  # scalar, added to the loss

    @classmethod
    def of_pixels(cls, rendering: Rendering, penalty: Tensor | None = None) -> TrainingRender:
        """Return the render of a model without Gaussians; in their place is one of opacity 0."""
        row = torch.zeros(1, 3)
        none = Gaussians(row, torch.ones(1, 4), row + 1, torch.zeros(1), row)
        return cls(rendering, torch.zeros(1, 2), none, torch.zeros(1, dtype=torch.int64), penalty=penalty)


@dataclass(frozen=True)
class Record:
    """One training iteration, after the optimizer step."""

    iteration: int  # 1 for the first
    progress: float  # share of the schedule, 1 for the last step
    loss: float | Tensor  # a scalar on the GPU if it has not been read: `float` then waits for the iteration
    seconds: float  # training time so far, without evaluation and files
    cpu_seconds: float  # the same, summed over all threads of the process
    counts: dict[str, int] = field(default_factory=dict)  # anchors, drawn Gaussians, ...
    events: tuple[str, ...] = ()  # such as "grew 120 anchors"


class Model(Protocol):
    """A model in training: parameters, learning rates and densification.

    `load_state` restores all of `state`, sizes included; it may replace the data of parameters, but not these.
    """

    def groups(self) -> list[ParameterGroup]:
        """Return all learnable parameters, each in exactly one group, with their learning rates."""
        ...

    def draw(self, view: View) -> TrainingRender:
        """Render a view, differentiably."""
        ...

    def observe(self, drawing: TrainingRender, iteration: int) -> None:
        """Collect statistics; called after `backward` and before the optimizer step."""

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Densify and prune if that is due; called after the optimizer step. Return events for the record."""
        ...

    def render(self, view: View) -> Rendering:
        """Render a view without gradients."""
        ...

    def counts(self) -> dict[str, int]:
        """Return the present counts: anchors, gaussians, ..."""
        ...

    def size(self) -> Size:
        """Return the size of the model."""
        ...

    def state(self) -> State:
        """Return parameters, statistics and random state, without the optimizer; not copies."""
        ...

    def load_state(self, state: State) -> None:
        """Restore the model from `state`."""

    def load_model(self, state: State) -> None:
        """Load the parameters alone, for a warm start."""


@dataclass(frozen=True)
class Parts:
    """Gaussians of a prunable model in one view, and the row that each belongs to."""

    gaussians: Gaussians  # the N that are drawn
    slots: Tensor  # [N] int64, unique; the same Gaussian has the same slot in all views
    each: int  # largest number of Gaussians of a row; row i has the slots from i * each on
    options: RenderOptions


@runtime_checkable
class Prunable(Model, Protocol):
    """A model whose rows (Gaussians or anchors) can be pruned."""

    def parts(self, view: View) -> Parts:
        """Return the Gaussians in a view; raises ValueError if views are not drawn by a plain `render`."""
        ...

    def prune(self, count: int, views: Sequence[View]) -> None:
        """Keep the `count` rows that are most important to the views."""

    def keep(self, rows: Tensor) -> None:
        """Keep only some rows, [N] bool or ascending row numbers, of all that has rows except an optimizer."""


class Refined:
    """A model that does not densify or prune; its learning rates are those of the last fifth of a schedule."""

    def __init__(self, model: Model, learning_rates: str | float, iterations: int) -> None:
        """Wrap a model that was built for a schedule of `iterations`; `learning_rates` as in `TrainOptions`."""
        self._model, self._iterations = model, iterations
        self._pace = Pace.of(learning_rates, iterations)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._model, name)

    def groups(self) -> list[ParameterGroup]:
        """Return the parameter groups of the model with the learning rates of a refinement."""
        return [replace(g, learning_rate=partial(self._rate, g), paced=False) for g in self._model.groups()]

    def _rate(self, group: ParameterGroup, step: int) -> float:
        iteration: Any = self._iterations - REPLAYED * (self._iterations - step)  # schedules take floats, too
        return group.rate(iteration, self._pace)

    def observe(self, drawing: TrainingRender, iteration: int) -> None:
        """Do nothing: without densification no statistics are needed."""

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Let a smoothing filter follow the parameters, and do nothing else."""
        if (follow := getattr(self._model, "follow", None)) is not None:
            follow(iteration)
        return ()
