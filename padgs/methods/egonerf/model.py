"""EgoNeRF in training: a radiance field with learning rates, and the trainer that draws random rays."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import ClassVar, cast

import torch
from torch import Tensor

from padgs.geometry.camera import Camera
from padgs.geometry.panorama import Device
from padgs.methods.egonerf.field import EgoNeRF
from padgs.render import Rendering
from padgs.scene import Scene, View
from padgs.training.loop import Stage, Trainer
from padgs.training.model import Model, Size, State
from padgs.training.options import Budget, TrainOptions
from padgs.training.schedule import LogLinear, ParameterGroup
from padgs.training.targets import image_of, weight_of

RATES = {"density": 0.02, "appearance": 0.02, "shader": 1e-3, "environment": 5e-3}  # of Adam at the start
RATE_DECAY = 0.1  # rates and weights of the total variation decay exponentially to this share
VARIATION_FACTOR = 1e-2  # published, on both weights of the total variation


class EgoNeRFModel:
    """An EgoNeRF with the schedule of a run; trained by `RayTrainer`."""

    def __init__(self, field: EgoNeRF, iterations: int) -> None:
        self.field, self._options, self._iterations = field, field.options, iterations

    def groups(self) -> list[ParameterGroup]:
        return [
            ParameterGroup(name, tuple(part.parameters()), self._decaying(RATES[name]))
            for name, part in self.field.named_children()
        ]

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
        return {"parameters": sum(p.numel() for p in self.field.parameters())}

    def render(self, view: View) -> Rendering:
        return self.field.render(view)

    def summary(self) -> str:
        """Return the surroundings and constants as a sentence."""
        values = self.field.constants._asdict().items()
        return f"{self.field.kind} constants: {', '.join(f'{name} {value}' for name, value in values)}"

    def size(self) -> Size:
        return Size.of({}, self.field.parameters(), stored=self.field.parameters())

    def state(self) -> State:
        """Return the parameters and the frame of the model; not copies."""
        field = self.field
        values = {"unit": field.unit, "travel": field.travel, "kind": field.kind, "centre": field.centre.tolist()}
        return State(dict(field.state_dict()), values)

    def load_model(self, state: State) -> None:
        """Load the parameters of a model of the same size and frame; there is no further state."""
        self.field.load_state_dict(state.tensors)

    load_state = load_model

    def _decaying(self, rate: float) -> LogLinear:
        """Return an exponential decay from `rate` over the run."""
        return LogLinear(rate, rate * RATE_DECAY, self._iterations)


class RayTrainer(Trainer):
    """Trainer on the mean squared error of random rays from all views; records hold the loss without regularisation."""

    ADAM_EPS: ClassVar[float] = 1e-8

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
        self._pixels = RayPixels(scene.train, options.weight, self._device, seed)
        self._order = self._pixels

    def _gradients(self, iteration: int, step: int) -> tuple[float | Tensor, dict[str, int]]:
        model, generator = self._model, self._pixels.generator
        with self._stage("target"):
            rays = self._pixels.draw(self._rays)
        value, read = rays.weight.new_zeros((), dtype=torch.float64), 0.0
        total = 3 * rays.weight.sum()
        for part in torch.arange(self._rays, device=total.device).split(model.field.options.rays_at_once):
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
        self._optimizer.check(iteration)
        with self._stage("optimizer"):
            self._optimizer.step(step)
        return (self._model.summary(),) if iteration == 1 else ()


@dataclass(frozen=True)
class Rays:
    """B rays and their ground truth."""

    origins: Tensor  # [B, 3] float64 world
    directions: Tensor  # [B, 3] unit, world
    color: Tensor  # [B, 3] in [0, 1]
    weight: Tensor  # [B] > 0


class RayPixels:
    """All unmasked pixels of some views; 7 bytes per pixel, 11 if weights differ. `generator` makes random choices."""

    def __init__(self, views: Sequence[View], weight: str = "uniform", device: Device = "cpu", seed: int = 0) -> None:
        """Load every view once; `weight` is a name of `padgs.training.loss.ROW_WEIGHTS`."""
        colors, places, weights = [], [], []
        tables: dict[Camera, tuple[int, Tensor]] = {}  # start among all directions, directions
        starts, total = [], 0
        for view in views:
            image, of_pixel = image_of(view, device), weight_of(view, weight, device)
            if view.lens is not None and weight == "solid_angle":
                scale = (views[0].camera.focal / view.camera.focal) ** 2
            else:  # as where an iteration draws a whole view
                scale = view.sphere_share * views[0].width * views[0].height / (view.width * view.height)
            of_pixel = view.share * scale * of_pixel
            of_pixel = of_pixel.expand(view.height, view.width).reshape(-1)
            kept = of_pixel.nonzero().squeeze(-1)
            colors.append((image.reshape(-1, 3)[kept] * 255).round().to(torch.uint8))
            places.append(kept.to(torch.int32))
            weights.append(of_pixel[kept])
            if view.camera not in tables:
                tables[view.camera] = total, view.camera.rays(device=device).reshape(-1, 3)
                total += view.width * view.height
            starts.append(tables[view.camera][0])
        self._colors, self._places = torch.cat(colors), torch.cat(places)
        self._weights = None if all((w == 1).all() for w in weights) else torch.cat(weights)
        self._directions = torch.cat([table for _, table in tables.values()])
        self._starts = torch.tensor(starts, device=device)
        self._ends = torch.tensor([len(place) for place in places], device=device).cumsum(0)
        self._centers = torch.stack([view.center.double() for view in views]).to(device)
        self.generator = torch.Generator().manual_seed(seed)
        self._rotations = torch.stack([view.cam_from_world[:3, :3] for view in views]).to(self._directions)

    def __len__(self) -> int:
        return len(self._colors)

    def draw(self, count: int) -> Rays:
        """Return `count` rays through the centres of random pixels, uniformly, with replacement."""
        return self.at(torch.randint(len(self), (count,), generator=self.generator).to(self._colors.device))

    def at(self, indices: Tensor) -> Rays:
        """Return the rays through pixels [B], counted view by view and row by row."""
        view = torch.searchsorted(self._ends, indices, right=True)
        in_camera = self._directions[self._starts[view] + self._places[indices]]
        directions = torch.einsum("bc,bcw->bw", in_camera, self._rotations[view])
        weight = torch.ones_like(directions[:, 0]) if self._weights is None else self._weights[indices]
        return Rays(self._centers[view], directions, self._colors[indices].to(directions) / 255, weight)

    def state(self) -> State:
        """Return the random state."""
        return State({"random/rays": self.generator.get_state()}, {"pixels": len(self)})

    def load(self, state: State) -> None:
        """Restore it from the state of a trainer."""
        if state.values["pixels"] != len(self):
            raise ValueError(
                f"the state is of a run on {state.values['pixels']} pixels, but the training views have {len(self)}; "
                "resume with the data it was trained on"
            )
        self.generator.set_state(state.tensors["random/rays"].cpu())
