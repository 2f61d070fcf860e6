"""Example of a method in another package, without Gaussians: a panorama that is infinitely far away."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch

from padgs.checks import check
from padgs.geometry.panorama import sample
from padgs.render import Rendering
from padgs.scene import Scene, View
from padgs.training.method import Method
from padgs.training.model import Size, State, TrainingRender
from padgs.training.schedule import Constant, ParameterGroup


@dataclass(frozen=True)
class MyOptions:
    """The `method` group for `method=my_method`."""

    height: int = 64  # pixels of the far panorama, which is twice as wide
    rate: float = 0.02  # learning rate of Adam

    def __post_init__(self) -> None:
        check(self, "at least 2", lambda height: height >= 2, "height")
        check(self, "> 0 and finite", lambda rate: 0 < rate < math.inf, "rate")


class FarPanorama:
    """See `padgs.training.model.Model`."""

    def __init__(self, options: MyOptions) -> None:
        self.pixels = torch.nn.Parameter(torch.full((options.height, 2 * options.height, 3), 0.5))
        self._rate = options.rate

    def groups(self) -> list[ParameterGroup]:
        """Return the parameters with their learning rates; the loop has an Adam for all."""
        return [ParameterGroup("pixels", (self.pixels,), Constant(self._rate))]

    def draw(self, view: View) -> TrainingRender:
        """Render a view of any camera, differentiably."""
        directions = view.camera.rays() @ view.cam_from_world[:3, :3].float()  # world axes; the origin does not matter
        zeros = torch.zeros(view.height, view.width)
        image = sample(self.pixels, directions)
        return TrainingRender.of_pixels(Rendering(image, zeros, zeros, torch.zeros(1, dtype=torch.bool)))

    @torch.no_grad()
    def render(self, view: View) -> Rendering:
        """Render a view."""
        return self.draw(view).rendering

    def observe(self, drawing: TrainingRender, iteration: int) -> None:
        """Do nothing between `backward` and the optimizer step."""

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Neither grow nor prune."""
        return ()

    def counts(self) -> dict[str, int]:
        """Return what the progress line and the tables show."""
        return {"pixels": self.pixels[..., 0].numel()}

    def size(self) -> Size:
        """Return numbers for the tables."""
        return Size.of(self.counts(), [self.pixels], stored=[self.pixels])

    def state(self) -> State:
        """Return all that rendering and resuming need."""
        return State({"pixels": self.pixels}, {})

    def load_state(self, state: State) -> None:
        """Restore what `state` returned."""
        self.load_model(state)

    def load_model(self, state: State) -> None:
        """Begin with the parameters of another run."""
        self.pixels.data.copy_(state.tensors["pixels"])


class MyMethod(Method):
    """See `padgs.training.method.Method`."""

    Options: ClassVar[type] = MyOptions
    title, color = "My method", "#8a5a2b"  # in tables and charts

    def build_model(self, scene: Scene, iterations: int) -> FarPanorama:
        """See `Method.build_model`."""
        return FarPanorama(self.options)

    def restore(self, state: State) -> FarPanorama:
        """See `Method.restore`."""
        return FarPanorama(self.options)
