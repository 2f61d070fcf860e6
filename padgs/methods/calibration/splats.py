"""Explicit Gaussians whose cameras learn too: the splats of 3DGS and a `Calibration`, as a trainee."""

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

PREFIX = "calibration/"  # of its tensors in a state


class Calibration(nn.Module, ABC):
    """A differentiable model of the cameras that draws views through itself."""

    @abstractmethod
    def groups(self, iterations: int) -> list[ParameterGroup]:
        """Its parameters and their learning rates in a run of `iterations`."""

    @abstractmethod
    def draw(self, draw: Callable[..., TrainingRender], view: View) -> TrainingRender:
        """Draw a training view as its camera takes it; `draw(view, probe=None)` draws as an ideal camera does."""

    @abstractmethod
    def summary(self) -> str:
        """What was found, for people."""

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """What it consists of: poses, lenses, ..."""

    @abstractmethod
    def values(self) -> dict[str, Any]:
        """What building it again takes besides the options, as JSON can hold it."""


class CalibratedModel(SplatModel):
    """Splats that are drawn through a calibration in training; `render` stays that of an ideal camera."""

    def __init__(self, *args: Any, calibration: Calibration, **kwargs: Any) -> None:
        """Arguments as for `SplatModel`, and the calibration that is optimised along with the splats."""
        super().__init__(*args, **kwargs)
        self.calibration = calibration

    def groups(self) -> list[ParameterGroup]:
        """Those of the splats and of the cameras."""
        return super().groups() + self.calibration.groups(self.iterations)

    def parts(self, view: View) -> Parts:
        """Refused: a photograph says little about what an ideal camera in its supposed place sees.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            "its cameras learn along, so photographs cannot be compared with what stands at their poses; take a method "
            "that does not calibrate"
        )

    def draw(self, view: View, mean_offsets: Tensor | None = None) -> TrainingRender:
        """Render all Gaussians as the camera of the view takes them, differentiably."""
        return self.calibration.draw(super().draw, view)

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """As the splats do; the last event of a whole run says what was found of the cameras."""
        events = super().adapt(iteration, optimizer)
        return (*events, self.calibration.summary()) if iteration == self.iterations else events

    def size(self) -> Size:
        """Counts and bytes of the model, calibration included."""
        size = super().size()
        parameters = list(self.calibration.parameters())
        own = Size.of(self.calibration.counts(), parameters, stored=parameters)
        return Size({**size.counts, **own.counts}, size.parameters + own.parameters, size.bytes + own.bytes)

    def state(self) -> State:
        """That of the splats, and the calibration."""
        state = super().state()
        tensors = {PREFIX + name: tensor for name, tensor in self.calibration.state_dict().items()}
        return State(state.tensors | tensors, state.values | {"calibration": self.calibration.values()})

    def load_model(self, state: State) -> None:
        """Take the splats and the calibration alone."""
        super().load_model(state)
        self.calibration.load_state_dict(state.under(PREFIX))


class CalibratedMethod(SplatMethod):
    """A method whose cameras learn, too; a subclass says which calibration they have."""

    MODEL = CalibratedModel
    _calibration: Calibration  # what the next trainee is made with

    @abstractmethod
    def _as_given(self, scene: Scene) -> Calibration:
        """The calibration that training starts with."""

    @abstractmethod
    def _as_stored(self, values: Mapping[str, Any]) -> Calibration:
        """A calibration of the shape that `Calibration.values` tells; its tensors are loaded afterwards."""

    @property
    def _views_learn(self) -> bool:
        return True

    def refuse_budget(self, budget: Budget) -> None:
        """Poses as given, which the choice scores Gaussians from, may be far from where the cameras end."""
        super().refuse_budget(budget)
        if budget.gaussians == "auto":
            raise ValueError(
                "budget.gaussians is auto, which scores Gaussians from the poses as given, but cameras learn along "
                "here; set it to a number or null"
            )

    def build_model(self, scene: Scene, iterations: int) -> SplatModel:
        """See `Method.build_model`."""
        self._calibration = self._as_given(scene)
        return super().build_model(scene, iterations)

    def restore(self, state: State) -> SplatModel:
        """See `Method.restore`."""
        self._calibration = self._as_stored(state.of_model().values["calibration"])
        return super().restore(state)

    def _model_of(self, splats: Splats, *args: Any, **more: Any) -> SplatModel:
        self._calibration.to(splats.means.device)
        return super()._model_of(splats, *args, calibration=self._calibration, **more)
