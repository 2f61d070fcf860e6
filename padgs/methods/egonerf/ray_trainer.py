"""Training on rays drawn from all views at once, in the loop that trains on whole views."""

from __future__ import annotations

import math
from contextlib import nullcontext
from typing import Any, ClassVar, cast

import torch
from torch import Tensor

from padgs.clock import Lap
from padgs.methods.egonerf.ray_pixels import RayPixels
from padgs.methods.egonerf.trainee import EgoNeRFTrainee
from padgs.scene import Scene
from padgs.training.loop import Stage, Trainer
from padgs.training.model import Model
from padgs.training.options import Budget, TrainOptions


class RayTrainer(Trainer):
    """Optimises the mean squared error of random rays, each pixel as likely as any other.

    The loss of a record is that error alone, without regularisation.
    """

    ADAM: ClassVar[dict[str, Any]] = {"betas": (0.9, 0.99), "eps": 1e-8}

    def __init__(
        self,
        trainee: EgoNeRFTrainee,
        scene: Scene,
        budget: Budget,
        options: TrainOptions,
        seed: int = 0,
        *,
        rays: int,
        stage: Stage = nullcontext,
    ) -> None:
        """Load all pixels; nothing is traced yet.

        Args:
            trainee, scene, budget: as of any trainer.
            options: the weight of pixels in the mean, which masks weigh too, and how often all is checked.
            seed: decides which rays are drawn, and how their samples are jittered.
            rays: rays of an iteration.
            stage: as of any trainer.

        Raises:
            ValueError: the pixels of a view cannot be used.
        """
        # Rays are all that it draws, so of a trainee it has what does not depend on views.
        super().__init__(cast(Model, trainee), scene, budget, options, seed, stage=stage)
        self._tracer, self._rays = trainee, rays
        lap = Lap()
        self._pixels = RayPixels(scene.train, options.weight, self._optimizer.device, seed)
        self._order = self._pixels
        self.seconds, self.cpu_seconds = lap.seconds()  # reading images is training, as where they are read one by one

    def _step(self, iteration: int, moment: int) -> tuple[float | Tensor, dict[str, int], tuple[str, ...]]:
        tracer, optimizer, generator = self._tracer, self._optimizer, self._pixels.generator
        with self._stage("target"):
            rays = self._pixels.draw(self._rays)
        value = rays.weight.new_zeros((), dtype=torch.float64)
        total = 3 * rays.weight.sum()
        for part in torch.arange(self._rays, device=total.device).split(tracer.rays_at_once):
            with self._stage("draw"):
                image = tracer.colors(rays.origins[part], rays.directions[part], generator, moment)
            error = (image - rays.color[part]).square() * rays.weight[part, None]
            loss = error.sum() / total
            value += loss.detach()
            read = self._read(value, iteration)
            if isinstance(read, float) and not math.isfinite(read):
                optimizer.refuse_non_finite({**optimizer.parameters(), "image": image, "loss": loss}, iteration)
            with self._stage("backward"):
                loss.backward()
        with self._stage("backward"):
            extra = tracer.regularisation(moment)
            if extra is not None:
                extra.backward()
        optimizer.check(iteration, moment)
        with self._stage("optimizer"):
            optimizer.step(moment)
        events = (tracer.summary(),) if iteration == 1 else ()
        return self._read(value, iteration), {**tracer.counts(), "rays": self._rays}, events
