"""Explicit Gaussians with a learned camera model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from padgs.methods.splats.method import SplatMethod
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import Splats
from padgs.scene import Scene, View
from padgs.training.model import Parts, Size, State, TrainingRender
from padgs.training.options import Budget
from padgs.training.schedule import ParameterGroup

PREFIX = "calibration/"  # of the camera model's tensors in a state


class Calibration(nn.Module, ABC):
    """A differentiable camera model through which training views are rendered."""

    @abstractmethod
    def groups(self, iterations: int) -> list[ParameterGroup]:
        """Return the parameters and their learning rates in a run of `iterations`."""

    @abstractmethod
    def draw(self, draw: Callable[..., TrainingRender], view: View) -> TrainingRender:
        """Render a training view through the camera; `draw(view, mean_offsets=None)` renders an ideal camera."""

    @abstractmethod
    def summary(self) -> str:
        """Return the result as a sentence."""

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """Return the numbers of poses, lenses, ..."""

    @abstractmethod
    def values(self) -> dict[str, Any]:
        """Return what restoring takes besides the options, as JSON values."""


class CalibratedModel(SplatModel):
    """Splats that are trained through a calibration; `render` is that of an ideal camera."""

    def __init__(self, *args: Any, calibration: Calibration, **kwargs: Any) -> None:
        """Take arguments of `SplatModel` and the calibration that is learned with the splats."""
        super().__init__(*args, **kwargs)
        self.calibration = calibration

    def groups(self) -> list[ParameterGroup]:
        """Return the learning rates of splats and cameras."""
        return super().groups() + self.calibration.groups(self.iterations)

    def parts(self, view: View) -> Parts:
        """Refuse: images of learned cameras cannot be compared with renders of the given ones.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            "its cameras are learned, so images cannot be compared with renders at the given poses; take a method "
            "without calibration"
        )

    def draw(self, view: View, mean_offsets: Tensor | None = None) -> TrainingRender:
        """Render all Gaussians through the camera model, differentiably."""
        return self.calibration.draw(super().draw, view)

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Adapt the splats; the last event of a run is the summary of the calibration."""
        events = super().adapt(iteration, optimizer)
        return (*events, self.calibration.summary()) if iteration == self.iterations else events

    def size(self) -> Size:
        """Return counts and bytes of the model, calibration included."""
        size = super().size()
        parameters = list(self.calibration.parameters())
        own = Size.of(self.calibration.counts(), parameters, stored=parameters)
        return Size({**size.counts, **own.counts}, size.parameters + own.parameters, size.bytes + own.bytes)

    def state(self) -> State:
        """Return the state of splats and calibration."""
        state = super().state()
        tensors = {PREFIX + name: tensor for name, tensor in self.calibration.state_dict().items()}
        return State(state.tensors | tensors, state.values | {"calibration": self.calibration.values()})

    def load_model(self, state: State) -> None:
        """Load the parameters of splats and calibration only."""
        super().load_model(state)
        self.calibration.load_state_dict(state.under(PREFIX))


class CalibratedMethod(SplatMethod):
    """A method with a learned camera model; subclasses build it."""

    MODEL = CalibratedModel
    _calibration: Calibration  # of the next model

    @abstractmethod
    def initial_calibration(self, scene: Scene) -> Calibration:
        """Return the calibration that training starts with."""

    @abstractmethod
    def restored_calibration(self, values: Mapping[str, Any]) -> Calibration:
        """Return a calibration for `Calibration.values`; its tensors are loaded afterwards."""

    @property
    def _views_learn(self) -> bool:
        return True

    def refuse_budget(self, budget: Budget) -> None:
        """Refuse pruning by importance, which would be scored from the given poses."""
        super().refuse_budget(budget)
        if budget.gaussians == "auto":
            raise ValueError(
                "budget.gaussians is auto, which scores Gaussians from the given poses, but cameras are learned here; "
                "set it to a number or null"
            )

    def build_model(self, scene: Scene, iterations: int) -> SplatModel:
        """See `Method.build_model`."""
        self._calibration = self.initial_calibration(scene)
        return super().build_model(scene, iterations)

    def restore(self, state: State) -> SplatModel:
        """See `Method.restore`."""
        self._calibration = self.restored_calibration(state.of_model().values["calibration"])
        return super().restore(state)

    def _model_of(self, splats: Splats, *args: Any, **more: Any) -> SplatModel:
        self._calibration.to(splats.means.device)
        return super()._model_of(splats, *args, calibration=self._calibration, **more)
