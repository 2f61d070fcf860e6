"""EgoNeRF as the training loop sees it: a model, its learning rates and its regularisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.checks import check
from padgs.methods.egonerf.model import EgoNeRF
from padgs.render import Rendering
from padgs.scene import View
from padgs.training.model import Size, State
from padgs.training.schedule import LogLinear, ParameterGroup

VARIATION_FACTOR = 1e-2  # published, on both weights


@dataclass(frozen=True)
class EgoNeRFTraining:
    """What is published for Ricoh360."""

    rays: int = 4096  # of an iteration
    grid_rate: float = 0.02  # learning rates of Adam at the start
    network_rate: float = 1e-3  # bases and network
    environment_rate: float = 5e-3  # of the picture behind everything
    environment_pretraining: int = 0  # iterations that teach it alone, first in the run; outdoor OmniBlender: 10 000
    pretraining_rate: float = 0.02  # of the environment then; no rate falls before they are over
    rate_decay: float = 0.1  # all rates, and the weights of the variation, fall exponentially to this share
    density_variation: float = 0.1  # weight of the total variation of the density planes; 0 for none
    appearance_variation: float = 0.01  # ... of the appearance planes

    def __post_init__(self) -> None:
        check(self, "at least 1", lambda count: count >= 1, "rays")
        check(self, "at least 0", lambda count: count >= 0, "environment_pretraining")
        rates = ("grid_rate", "network_rate", "environment_rate", "pretraining_rate", "rate_decay")
        check(self, "> 0", lambda rate: rate > 0, *rates)
        check(self, ">= 0", lambda weight: weight >= 0, "density_variation", "appearance_variation")

    def refuse_length(self, iterations: int) -> None:
        """Raise ValueError where pretraining leaves no iteration for the rest."""
        if self.environment_pretraining >= iterations:
            raise ValueError(
                f"environment_pretraining is {self.environment_pretraining} of {iterations} iterations, which leaves "
                "none for the grids; train longer, or lower it"
            )


class EgoNeRFTrainee:
    """An EgoNeRF with the schedule of a run, as `padgs.methods.egonerf.ray_trainer` wants it."""

    def __init__(self, model: EgoNeRF, options: EgoNeRFTraining, iterations: int) -> None:
        """Tie together a model and its learning rates in a run of `iterations`.

        Raises:
            ValueError: pretraining leaves no iteration for the rest, or there is no environment to be trained.
        """
        self.model, self._options, self._iterations = model, options, iterations
        options.refuse_length(iterations)
        alone = options.environment_pretraining
        if alone and model.environment is None:
            raise ValueError(
                f"environment_pretraining is {alone}, but {model.kind}s there is no environment; set "
                "environment_pretraining=0, environment=true or surroundings=outdoor"
            )

    @property
    def rays_at_once(self) -> int:
        """Rays of a pass."""
        return self.model.options.rays_at_once

    def groups(self) -> list[ParameterGroup]:
        """All parameters, by what they belong to."""
        model, options = self.model, self._options
        groups = [
            ParameterGroup("density", tuple(model.density.parameters()), self._decaying(options.grid_rate)),
            ParameterGroup("appearance", tuple(model.appearance.parameters()), self._decaying(options.grid_rate)),
            ParameterGroup("shader", tuple(model.shader.parameters()), self._decaying(options.network_rate)),
        ]
        if model.environment is not None:
            together = self._decaying(options.environment_rate)

            def rate(iteration: int) -> float:
                return options.pretraining_rate if self._pretrains(iteration) else together(iteration)

            groups.append(ParameterGroup("environment", tuple(model.environment.parameters()), rate))
        return groups

    def colors(self, origins: Tensor, directions: Tensor, generator: torch.Generator, iteration: int) -> Tensor:
        """Colours [B, 3] of rays in the world, with jittered samples; of the environment while it learns alone."""
        if self.model.environment is not None and self._pretrains(iteration):
            return self.model.environment(directions)
        return self.model.trace(self.model.from_world(origins), directions, generator).color

    def regularisation(self, iteration: int) -> Tensor | None:
        """Total variation of the planes, its weight falling like the learning rates."""
        options = self._options
        if self._pretrains(iteration):
            return None
        if options.density_variation == 0 and options.appearance_variation == 0:
            return None
        weighted = (
            options.density_variation * self.model.density.variation()
            + options.appearance_variation * self.model.appearance.variation()
        )
        return VARIATION_FACTOR * self._decaying(1.0)(iteration) * weighted

    def counts(self) -> dict[str, int]:
        """Number of parameters."""
        return {"parameters": sum(p.numel() for p in self.model.parameters())}

    def render(self, view: View) -> Rendering:
        """Render a view without gradients."""
        return self.model.render(view)

    def summary(self) -> str:
        """What kind of scene it took this for."""
        values = self.model.constants._asdict().items()
        return f"{self.model.kind} constants: {', '.join(f'{name} {value}' for name, value in values)}"

    def size(self) -> Size:
        """Parameters and their bytes."""
        return Size.of({}, self.model.parameters(), stored=self.model.parameters())

    def state(self) -> State:
        """The parameters, and where the model is; not copies."""
        model = self.model
        values = {"unit": model.unit, "travel": model.travel, "kind": model.kind, "centre": model.centre.tolist()}
        return State(dict(model.state_dict()), values)

    def load_state(self, state: State) -> None:
        """Take the parameters of a model of the same size and place."""
        self.load_model(state)

    def load_model(self, state: State) -> None:
        """The same, as nothing else is noted."""
        self.model.load_state_dict(state.tensors)

    def _pretrains(self, iteration: int) -> bool:
        return 0 < iteration <= self._options.environment_pretraining

    def _decaying(self, rate: float) -> Callable[[int], float]:
        """Learning rate by iteration: 0 while the environment learns alone, from `rate` on once all learn."""
        alone = self._options.environment_pretraining
        fall = LogLinear(rate, rate * self._options.rate_decay, self._iterations - alone)
        return lambda iteration: 0.0 if self._pretrains(iteration) else fall(iteration - alone)
