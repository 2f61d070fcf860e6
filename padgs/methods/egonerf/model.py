"""EgoNeRF in training: a radiance field with learning rates, and the trainer that draws random rays."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any, ClassVar, cast

import torch
from torch import Tensor

from padgs.methods.egonerf.field import EgoNeRF
from padgs.methods.egonerf.rays import RayPixels
from padgs.render import Rendering
from padgs.scene import Scene, View
from padgs.training.loop import Stage, Trainer
from padgs.training.model import Model, Size, State
from padgs.training.options import Budget, TrainOptions
from padgs.training.schedule import LogLinear, ParameterGroup

VARIATION_FACTOR = 1e-2  # published, on both weights of the total variation


class EgoNeRFModel:
    """An EgoNeRF with the schedule of a run; trained by `RayTrainer`."""

    def __init__(self, field: EgoNeRF, iterations: int) -> None:
        """Wrap a radiance field for a run of `iterations`."""
        self.field, self._options, self._iterations = field, field.options, iterations

    @property
    def rays_at_once(self) -> int:
        """Rays in one pass."""
        return self.field.options.rays_at_once

    def groups(self) -> list[ParameterGroup]:
        """Return all parameters with their learning rates."""
        field, options = self.field, self._options
        groups = [
            ParameterGroup("density", tuple(field.density.parameters()), self._decaying(options.grid_rate)),
            ParameterGroup("appearance", tuple(field.appearance.parameters()), self._decaying(options.grid_rate)),
            ParameterGroup("shader", tuple(field.shader.parameters()), self._decaying(options.network_rate)),
        ]
        if field.environment is not None:
            rate = self._decaying(options.environment_rate)
            groups.append(ParameterGroup("environment", tuple(field.environment.parameters()), rate))
        return groups

    def colors(self, origins: Tensor, directions: Tensor, generator: torch.Generator) -> Tensor:
        """Return colours [B, 3] of rays in the world with jittered samples."""
        return self.field.trace(self.field.from_world(origins), directions, generator).color

    def regularisation(self, iteration: int) -> Tensor | None:
        """Return the weighted total variation of the planes; its weight decays like the learning rates."""
        options = self._options
        if options.density_variation == 0 and options.appearance_variation == 0:
            return None
        weighted = (
            options.density_variation * self.field.density.variation()
            + options.appearance_variation * self.field.appearance.variation()
        )
        return VARIATION_FACTOR * self._decaying(1.0)(iteration) * weighted

    def counts(self) -> dict[str, int]:
        """Return the number of parameters."""
        return {"parameters": sum(p.numel() for p in self.field.parameters())}

    def render(self, view: View) -> Rendering:
        """Render a view without gradients."""
        return self.field.render(view)

    def summary(self) -> str:
        """Return the surroundings and constants as a sentence."""
        values = self.field.constants._asdict().items()
        return f"{self.field.kind} constants: {', '.join(f'{name} {value}' for name, value in values)}"

    def size(self) -> Size:
        """Return parameters and their bytes."""
        return Size.of({}, self.field.parameters(), stored=self.field.parameters())

    def state(self) -> State:
        """Return the parameters and the frame of the model; not copies."""
        field = self.field
        values = {"unit": field.unit, "travel": field.travel, "kind": field.kind, "centre": field.centre.tolist()}
        return State(dict(field.state_dict()), values)

    def load_state(self, state: State) -> None:
        """Load the parameters of a model of the same size and frame."""
        self.load_model(state)

    def load_model(self, state: State) -> None:
        """Load the parameters; there is no further state."""
        self.field.load_state_dict(state.tensors)

    def _decaying(self, rate: float) -> LogLinear:
        """Return an exponential decay from `rate` over the run."""
        return LogLinear(rate, rate * self._options.rate_decay, self._iterations)


class RayTrainer(Trainer):
    """Trainer on the mean squared error of random rays from all views; records hold the loss without regularisation."""

    ADAM: ClassVar[dict[str, Any]] = {"betas": (0.9, 0.99), "eps": 1e-8}

    def __init__(
        self,
        model: EgoNeRFModel,
        scene: Scene,
        budget: Budget,
        options: TrainOptions,
        seed: int = 0,
        *,
        rays: int,
        stage: Stage = nullcontext,
    ) -> None:
        """Load all pixels; `rays` is the number per iteration, other arguments are as for `Trainer`."""
        # The model has only those members of `Model` that do not depend on views.
        super().__init__(cast(Model, model), scene, budget, options, seed, stage=stage)
        self._model, self._rays = model, rays
        self._pixels = RayPixels(scene.train, options.weight, self._optimizer.device, seed)
        self._order = self._pixels

    def _gradients(self, iteration: int, step: int) -> tuple[float | Tensor, dict[str, int]]:
        model, generator = self._model, self._pixels.generator
        with self._stage("target"):
            rays = self._pixels.draw(self._rays)
        value, read = rays.weight.new_zeros((), dtype=torch.float64), 0.0
        total = 3 * rays.weight.sum()
        for part in torch.arange(self._rays, device=total.device).split(model.rays_at_once):
            with self._stage("draw"):
                image = model.colors(rays.origins[part], rays.directions[part], generator)
            error = (image - rays.color[part]).square() * rays.weight[part, None]
            loss = error.sum() / total
            value += loss.detach()
            read = self._optimizer.read(value, {"image": image}, iteration)
            with self._stage("backward"):
                loss.backward()
        with self._stage("backward"):
            extra = model.regularisation(step)
            if extra is not None:
                extra.backward()
        return read, {"rays": self._rays}

    def _update(self, iteration: int, step: int) -> tuple[str, ...]:
        self._optimizer.check(iteration, step)
        with self._stage("optimizer"):
            self._optimizer.step(step)
        return (self._model.summary(),) if iteration == 1 else ()
