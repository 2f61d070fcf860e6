"""Refinement of a warm-started model, and training without the validation views: `train.refine`, `train.hold_out`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch

from padgs.scene import View
from padgs.training.health import validation_split
from padgs.training.model import Model, TrainingRender
from padgs.training.schedule import Pace, ParameterGroup

REPLAYED = 0.2  # share of a schedule, at its end, whose learning rates a refinement goes through


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
        return [replace(g, learning_rate=self._rate(g), paced=False) for g in self._model.groups()]

    def _rate(self, group: ParameterGroup) -> Callable[[int], float]:
        def rate(step: int) -> float:
            iteration: Any = self._iterations - REPLAYED * (self._iterations - step)  # schedules take floats, too
            return group.learning_rate(iteration) * (self._pace(iteration) if group.paced else 1.0)

        return rate

    def observe(self, drawing: TrainingRender, iteration: int) -> None:
        """Do nothing: without densification no statistics are needed."""

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Do nothing."""
        return ()


def held_out(views: Sequence[View]) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Return the views to train on, and the validation views.

    Raises:
        ValueError: as `validation_split`.
    """
    chosen = validation_split(views)
    return tuple(v for n, v in enumerate(views) if n not in chosen), tuple(views[n] for n in chosen)
