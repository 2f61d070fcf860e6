"""Training on rays drawn from all views at once."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from padgs.learning.loop import Optimisable, TrainingLoop
from padgs.learning.method import Budget, State
from padgs.learning.ray_pixels import RayPixels
from padgs.scene import View


class RayTrainable(Optimisable, Protocol):
    """A model that a `RayTrainer` can optimise."""

    @property
    def rays_at_once(self) -> int:
        """How many rays may be traced before memory has to be given back; gradients add up over such passes."""
        ...

    def colors(self, origins: Tensor, directions: Tensor, generator: torch.Generator, iteration: int) -> Tensor:
        """Colours [B, 3], differentiable, of rays from [B, 3] float64 in unit directions [B, 3], both world."""
        ...

    def regularisation(self, iteration: int) -> Tensor | None:
        """What is added to the loss, a scalar; None where nothing is."""
        ...


class RayTrainer(TrainingLoop):
    """Optimises the mean squared error of random rays, each pixel as likely as any other.

    The loss of a record is that error alone, without regularisation.
    """

    def __init__(
        self,
        model: RayTrainable,
        views: Sequence[View],
        budget: Budget,
        *,
        rays: int,
        weight: str = "uniform",
        check_every: int = 50,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-8,
        seed: int = 0,
    ) -> None:
        """Load all pixels; nothing is traced yet.

        Args:
            model: what is optimised.
            views: the training views.
            budget: for how long.
            rays: rays of an iteration.
            weight: of the pixels in the mean, a name of `padgs.learning.loss.ROW_WEIGHTS`; masks weigh them too.
            check_every, betas, eps: see `TrainingLoop`.
            seed: decides which rays are drawn, and how their samples are jittered.

        Raises:
            ValueError: there is no view, or its pixels cannot be used.
        """
        if not views:
            raise ValueError("the scene has no training view; mend its split")
        super().__init__(model, budget, check_every=check_every, betas=betas, eps=eps)
        self._tracer, self._rays = model, rays
        device = self._groups[0].parameters[0].device
        started = time.perf_counter()
        self._pixels = RayPixels(views, weight, device)
        self.seconds = time.perf_counter() - started  # reading images is training, as where they are read view by view
        self._generator = torch.Generator().manual_seed(seed)

    def _step(self, iteration: int) -> tuple[float | Tensor, dict[str, int], tuple[str, ...]]:
        rays = self._pixels.draw(self._rays, self._generator)
        value = rays.weight.new_zeros((), dtype=torch.float64)
        total = 3 * rays.weight.sum()
        for part in torch.arange(self._rays, device=total.device).split(self._tracer.rays_at_once):
            image = self._tracer.colors(rays.origins[part], rays.directions[part], self._generator, iteration)
            error = (image - rays.color[part]).square() * rays.weight[part, None]
            loss = error.sum() / total
            value += loss.detach()
            read = self._read(value, iteration)
            if isinstance(read, float) and not math.isfinite(read):
                self._refuse_non_finite({**self._parameters(), "image": image, "loss": loss}, iteration)
            loss.backward()
        extra = self._tracer.regularisation(iteration)
        if extra is not None:
            extra.backward()
        self._check(iteration)
        self._update()
        return self._read(value, iteration), {**self._tracer.counts(), "rays": self._rays}, ()

    def _order_state(self) -> State:
        return State({"random/rays": self._generator.get_state()}, {"pixels": len(self._pixels)})

    def _load_order(self, state: State) -> None:
        if state.values["pixels"] != len(self._pixels):
            raise ValueError(
                f"the state is of a run on {state.values['pixels']} pixels, but the training views have "
                f"{len(self._pixels)}; resume with the data it was trained on"
            )
        self._generator.set_state(state.tensors["random/rays"].cpu())
