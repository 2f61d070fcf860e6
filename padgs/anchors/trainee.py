"""PaD-GS as the training loop sees it: a model, its growth and its learning rates."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from padgs.anchors.growth import Growth
from padgs.anchors.model import PaDGS
from padgs.learning.method import State
from padgs.learning.schedule import ParameterGroup
from padgs.learning.views import Drawing
from padgs.render import RenderOptions, render
from padgs.scene import View


@dataclass(frozen=True)
class AnchorDrawing(Drawing):
    """A drawing that remembers the opacities of all anchors, which decide what is pruned."""

    raw_opacities: Tensor  # [A, K]


class TrainablePaDGS:
    """A PaD-GS model with its growth, as `padgs.learning.views.Trainer` wants it."""

    def __init__(
        self, model: PaDGS, growth: Growth, groups: list[ParameterGroup], options: RenderOptions, backend: str
    ) -> None:
        """Tie together a model, its growth and its learning rates."""
        self.model, self.growth = model, growth
        self._groups, self._options, self._backend = groups, options, backend

    def groups(self) -> list[ParameterGroup]:
        """All learnable parameters; positions of anchors are none."""
        return self._groups

    def draw(self, view: View) -> AnchorDrawing:
        """Decode the anchors for the view and render them, differentiably."""
        decoded = self.model.decode(view)
        probe = decoded.gaussians.means.new_zeros(len(decoded.slots), 2, requires_grad=True)
        rendering = render(decoded.gaussians, view, self._options, probe=probe, backend=self._backend)
        return AnchorDrawing(rendering, probe, decoded.gaussians, decoded.slots, decoded.raw_opacities)

    def observe(self, drawing: Drawing, iteration: int) -> None:
        """Collect opacities and image-plane gradients."""
        assert isinstance(drawing, AnchorDrawing), type(drawing)
        gradient = drawing.probe.grad if drawing.probe.grad is not None else torch.zeros_like(drawing.probe)
        self.growth.observe(drawing.raw_opacities, drawing.slots, gradient, drawing.rendering.visible, iteration)

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Grow and prune anchors."""
        return self.growth.adapt(iteration, optimizer)

    def counts(self) -> dict[str, int]:
        """Number of anchors."""
        return {"anchors": len(self.model)}

    def state(self) -> State:
        """Model, growth statistics and random state."""
        growth = {f"growth/{name}": values for name, values in self.growth.statistics.items()}
        values = {"voxel_size": self.model.voxel_size, "unit": self.model.unit}
        return State({**self.model.state_dict(), **growth, "random/growth": self.growth.generator.get_state()}, values)

    def load_state(self, state: State) -> None:
        """Become what `state` was taken of, whatever the number of anchors."""
        self.model.load(state.tensors)
        self.model.voxel_size, self.model.unit = state.values["voxel_size"], state.values["unit"]
        for name in self.growth.statistics:
            self.growth.statistics[name] = state.tensors[f"growth/{name}"].to(self.model.positions.device, copy=True)
        self.growth.generator.set_state(state.tensors["random/growth"].cpu())
