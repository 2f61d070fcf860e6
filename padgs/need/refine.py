"""Training a finished model a little more: nothing grows, and learning rates fall once more."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from padgs.render import Rendering
from padgs.scene import View
from padgs.training.model import Prunable, Size, State, TrainingRender
from padgs.training.options import TrainOptions
from padgs.training.schedule import Pace, ParameterGroup

SHARE = 0.04  # of the iterations of the run, in a refinement
REPLAYED = 0.2  # share of the run, at its end, whose learning rates a refinement goes through again


class Refining:
    """A trainee without growth and statistics, whose `steps` replay the last learning rates of a run."""

    def __init__(self, model: Prunable, options: TrainOptions, iterations: int, steps: int) -> None:
        """Wrap a model of a run of so many `iterations`, trained with `options`."""
        self._model, self._iterations, self._steps = model, iterations, steps
        self._pace = Pace.of(options.learning_rates, iterations)

    def groups(self) -> list[ParameterGroup]:
        """Those of the model, at the rates of the end of its run."""
        return [replace(g, learning_rate=self._replayed(g), paced=False) for g in self._model.groups()]

    def _replayed(self, group: ParameterGroup) -> Callable[[int], float]:
        def rate(step: int) -> float:
            iteration = round(self._iterations * (1 - REPLAYED * (1 - step / self._steps)))
            return group.learning_rate(iteration) * (self._pace(iteration) if group.paced else 1.0)

        return rate

    def draw(self, view: View) -> TrainingRender:
        """As the model does."""
        return self._model.draw(view)

    def observe(self, drawing: TrainingRender, iteration: int) -> None:
        """Nothing grows, so nothing is noted."""

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Nothing grows."""
        return ()

    def counts(self) -> dict[str, int]:
        """Of the model."""
        return self._model.counts()

    def render(self, view: View) -> Rendering:
        """As the model does."""
        return self._model.render(view)

    def size(self) -> Size:
        """Of the model."""
        return self._model.size()

    def state(self) -> State:
        """Of the model."""
        return self._model.state()

    def load_state(self, state: State) -> None:
        """Of the model."""
        self._model.load_state(state)

    def load_model(self, state: State) -> None:
        """Of the model."""
        self._model.load_model(state)
